"""A recording published on the bus again."""
