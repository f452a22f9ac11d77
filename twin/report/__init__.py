"""A report on a twin: its content in numbers, a verdict in words, and one HTML page that needs nothing else."""
