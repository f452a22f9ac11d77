"""How long each input of each fan has been missing: statistics start again after a gap longer than their memory."""

from __future__ import annotations

import numpy as np

from schemas.messages import Array
from scoring.column_state import NEVER_NS, ColumnState


class Gaps(ColumnState):
    """The time of the last valid sample of each input and fan."""

    def __init__(self, inputs: int, fans: int) -> None:
        self._last_t_ns = np.full((inputs, fans), NEVER_NS, np.int64)

    def update(self, t_ns: Array, period_ns: int, valid: Array) -> Array:
        """Take a block: t_ns (n,), valid (n, inputs, fans).

        Returns (n, inputs, fans): the time without a valid sample before each valid one, ns; 0 for the first of all.
        """
        if len(t_ns) == 1:
            missing_ns = np.where(valid[0] & (self._last_t_ns != NEVER_NS), t_ns[0] - self._last_t_ns - period_ns, 0)
            np.copyto(self._last_t_ns, t_ns[0], where=valid[0])
            return missing_ns[np.newaxis]
        seen = np.where(valid, t_ns[:, np.newaxis, np.newaxis], NEVER_NS)
        last = np.maximum.accumulate(np.concatenate((self._last_t_ns[np.newaxis], seen)))
        self._last_t_ns = last[-1].copy()
        before = last[:-1]
        return np.where(valid & (before != NEVER_NS), seen - before - period_ns, 0)

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {"last_t_ns": self._last_t_ns}
