"""Acquisition: readings of a source become messages on the bus, and commands on the bus go to the source."""
