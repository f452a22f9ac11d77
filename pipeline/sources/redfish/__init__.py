"""Samples of the fans of a server, from its baseboard controller."""
