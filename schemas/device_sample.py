"""A sample of a device at the other end of a line, which is simulated or plays a table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class DeviceSample:
    """Measurement at t_s, s since the device started.

    Attributes:
        clock_us, sequence: modulo 2^32.
        command, speed_rad_s: (fans,).
        auxiliary: (fans,) what is measured beside command and speed, by the name of its channel.
        lost: it must not be sent, and uses up its sequence number.
    """

    t_s: float
    clock_us: int
    sequence: int
    command: NDArray[np.float64]
    speed_rad_s: NDArray[np.float64]
    auxiliary: Mapping[str, NDArray[Any]] = field(default_factory=dict[str, NDArray[Any]])
    lost: bool = False
