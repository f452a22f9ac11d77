"""Where samples come from: serial ports, simulated devices and measured tables."""
