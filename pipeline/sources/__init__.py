"""Where samples come from: a folder for each kind of source, with its settings and what reads from it."""
