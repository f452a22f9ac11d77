"""Simulated fans, trays and faults with known ground truth, for the demo, tests and benches."""
