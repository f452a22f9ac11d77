"""Simulated fans, trays and faults whose truth is known: used by demo, tests and benches."""
