"""The time of a sample: clocks of devices and hosts, the rate of a line, the grid of all fans of a tray."""
