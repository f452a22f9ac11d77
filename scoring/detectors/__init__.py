"""Statistics on residuals: one detector a file."""
