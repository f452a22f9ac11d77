"""Tables of measured samples, and how their columns become samples of fans."""
