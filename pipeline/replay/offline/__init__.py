"""A recording scored again without a bus, and compared with what was recorded."""
