"""Messages of a device without a clock, for tests of the resampler."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S

EPOCH_NS = 1_700_000_000_000_000_000
NAN = float("nan")


def at(*times_s: float) -> NDArray[np.int64]:
    return EPOCH_NS + np.rint(np.array(times_s) * NS_PER_S).astype(np.int64)


def raw(
    t_ns: NDArray[np.int64], speed: NDArray[np.float64], command: NDArray[np.float64] | None = None, fans: int = 1
) -> Raw:
    """A message of a device without a clock. speed, command: (n,) of every fan, or (n, fans)."""
    command = np.zeros(len(t_ns)) if command is None else command
    columns = [
        np.broadcast_to(np.asarray(c, float).reshape(len(t_ns), -1), (len(t_ns), fans)) for c in (command, speed)
    ]
    return Raw(fans=fans, host_receive_t_ns=t_ns, command=columns[0], speed_rad_s=columns[1])
