"""Commands that read, repair, convert and replay recordings."""
