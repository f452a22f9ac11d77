"""Slow change over days and weeks."""
