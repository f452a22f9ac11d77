"""Displays: the Rerun view, pictures and plots."""
