"""Logs of other systems: one reader a format, and how fields of a log become samples of fans."""
