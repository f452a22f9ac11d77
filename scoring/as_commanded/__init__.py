"""Checks that fans stand and turn as commanded: no prediction is needed for them."""
