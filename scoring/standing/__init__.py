"""Whether fans stand and turn as commanded: no prediction is needed for it."""
