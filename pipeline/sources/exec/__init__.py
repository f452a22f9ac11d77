"""Samples that a program prints, which acquisition runs."""
