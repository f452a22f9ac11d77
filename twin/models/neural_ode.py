"""The neural ODE: w' = W_o tanh(W_i [w, tau] + b_i) + b_o, equation (28) of Peng and Chen. 20 units, 81 parameters.

All fans share the network; of a fan's own parameters only the lag of its command enters.
"""

from typing import ClassVar

from fantwin.twin.models.fan_ode import NetworkOde

UNITS = 20


class NeuralOde(NetworkOde):
    """A network that is the whole right-hand side."""

    kind: ClassVar[str] = "neural-ode"
    has_physics: ClassVar[bool] = False
    used_parameters: ClassVar[tuple[str, ...]] = ("lag_s",)
