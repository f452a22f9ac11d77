"""Samples that a program posts to acquisition."""
