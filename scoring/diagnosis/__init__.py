"""Causes of alarms, in words: what the model found, how large it is, and what would tell where it is unclear."""
