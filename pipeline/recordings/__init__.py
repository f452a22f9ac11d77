"""Recordings: what went over the bus, in MCAP files."""

from pipeline.recordings.arrays import Block, read_arrays
from pipeline.recordings.reading import read_metadata, read_recording
from schemas.envelope import Envelope

__all__ = ["Block", "Envelope", "read_arrays", "read_metadata", "read_recording"]
