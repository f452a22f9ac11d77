"""Deciding: residuals to statistics, thresholds, states and causes. Pure; docs/deciding.md tells the whole."""
