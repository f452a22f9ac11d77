"""The hybrid: w' = (tau - alpha w - C_D w|w|) / J + network, equation (31) of Peng and Chen. 10 units.

Each fan has its own physics; all fans share one network for what the physics miss (friction, dead zone, drive). 41
weights on [w, tau] or 31 on [w]; with J, alpha and C_D 44 or 34 parameters.
"""

from typing import ClassVar

from fantwin.twin.models.fan_ode import NetworkOde
from fantwin.twin.models.physics import PARAMETER_NAMES

UNITS = 10


class Hybrid(NetworkOde):
    """Physics per fan and one shared network."""

    kind: ClassVar[str] = "hybrid"
    has_physics: ClassVar[bool] = True
    used_parameters: ClassVar[tuple[str, ...]] = PARAMETER_NAMES
