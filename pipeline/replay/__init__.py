"""Replay: a recording is published on the bus again, or scored again without a bus."""
