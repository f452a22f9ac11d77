"""The other end of a line: a simulated device, or one that plays a table."""
