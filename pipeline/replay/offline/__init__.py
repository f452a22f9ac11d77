"""A recording judged again without a bus, and compared with what was recorded."""
