"""Stages as child processes of one command, supervised and restarted."""
