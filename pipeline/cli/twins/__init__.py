"""Commands that make, calibrate and evaluate twins."""
