"""Where samples come from: sources, serial lines, simulated devices, measured tables, and the time of a sample."""
