"""Alarm limits from healthy recordings, for a declared false-alarm rate."""
