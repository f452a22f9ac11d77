"""From measured runs to the parameters of a model."""
