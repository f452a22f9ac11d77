"""The models of a fan: one kind a file."""
