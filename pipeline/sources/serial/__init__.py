"""Samples from a serial line, in frames or as lines of text."""
