"""What a residual owes to the fan and to the day, and not to a fault."""
