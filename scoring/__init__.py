"""Deciding: residuals to statistics, thresholds, states and causes. Pure; docs/explanation/deciding.md tells the
whole."""
