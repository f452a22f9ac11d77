"""Stages as child processes, watched from outside, and the accounting of what they lost."""
