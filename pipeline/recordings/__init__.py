"""Recordings: what went over the bus, in MCAP files."""
