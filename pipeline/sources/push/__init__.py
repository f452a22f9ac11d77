"""Samples that a Python program pushes over the bus."""
