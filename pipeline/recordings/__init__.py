"""Recordings: what went over the bus, in MCAP files."""

from pipeline.recordings.arrays import Block, read_arrays
from pipeline.recordings.reading import Entry, read_metadata, read_recording

__all__ = ["Block", "Entry", "read_arrays", "read_metadata", "read_recording"]
