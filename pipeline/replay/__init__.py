"""Replay: a recording published anew on the bus, or judged anew without one."""
