"""The one exception of the model maker."""


class TwinError(ValueError):
    """One line: what is wrong, where, and what to do about it."""
