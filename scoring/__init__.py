"""Scoring: from residuals to statistics, limits, alarm states and causes, without bus, clock or files.

docs/explanation/deciding.md explains the method.
"""
