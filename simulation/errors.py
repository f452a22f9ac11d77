"""The one exception of the simulation."""


class SimulationError(ValueError):
    """A setting of the simulation cannot be used. One line: what is wrong and what to do about it."""
