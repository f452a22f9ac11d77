"""Sources of samples: a folder for each kind, with its settings and what reads from it."""
