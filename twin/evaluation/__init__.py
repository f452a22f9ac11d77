"""How well a model follows measured runs."""
