"""Samples of the fans that the kernel of this host knows."""
