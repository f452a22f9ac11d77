"""Alarm limits from healthy running, for a declared false-alarm rate."""
