"""A report on a twin: its content in numbers, an assessment in words, and one HTML page that needs nothing else."""
