"""Measurements, as ratios: training, detection and runtime."""
