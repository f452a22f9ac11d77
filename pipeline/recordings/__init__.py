"""Recordings: what went over the bus, in MCAP files."""

from fantwin.pipeline.recordings.arrays import Block, read_arrays
from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.schemas.envelope import Envelope

__all__ = ["Block", "Envelope", "read_arrays", "read_metadata", "read_recording"]
