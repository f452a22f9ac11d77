"""The part of a residual that is specific to the fan or the day and is not a fault."""
