"""Recordings: what went over the bus, in MCAP files."""

from pipeline.recordings.arrays import Block, read_arrays
from pipeline.recordings.reading import Entry, read_head, read_recording

__all__ = ["Block", "Entry", "read_arrays", "read_head", "read_recording"]
