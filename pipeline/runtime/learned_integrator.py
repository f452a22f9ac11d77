"""The twin integrator of a tray whose twin is learned while it runs: a core for each version, one at a time.

A new twin takes over between two blocks, at the first sample that is newer than all before it. Its card, which is
published then, carries the twin and the time of that sample, so that a replay changes the twin at the same sample.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pipeline.config.models import TrayConfig
from pipeline.runtime.stage import Core, StageError
from pipeline.runtime.twin_file import TwinFile, learned_twin
from schemas.blocks import select
from schemas.messages import Grid, InvalidReason, Message, NewTwin, Prediction


class LearnedTwinIntegrator(Core):
    """Predicts by the newest twin it has received; without one, no sample is valid (NO_TWIN)."""

    def __init__(self, tray: TrayConfig, core_of: Callable[[TwinFile, int, bytes], Core]) -> None:
        """core_of: the core of a twin, from its first sample (time in ns) on, and the content of its file."""
        self._tray = tray
        self._core_of = core_of
        self._core: Core | None = None
        self._sha256 = ""
        """of the twin in force"""
        self._next: NewTwin | None = None
        self._newest_t_ns = np.iinfo(np.int64).min
        self._counts: Counter[str] = Counter()
        """of the cores before the current one"""
        self._problem = ""

    def step(self, item: Grid | NewTwin) -> Sequence[Message]:
        """Predict the speeds of a block, or receive the twin for those to come."""
        if isinstance(item, NewTwin):
            self._next = item
            return []
        if item.fans != self._tray.fans and self._core is None:
            self._counts["lost_wrong_fan_count"] += len(item.t_ns)
            self._problem = f"grid of {item.fans} fans, [[tray]] says fans = {self._tray.fans}: correct one of them"
            return []
        if len(item.t_ns) and item.t_ns[0] > self._newest_t_ns:
            self._take_over(int(item.t_ns[0]))
        new = item.t_ns > np.maximum.accumulate(np.concatenate(([self._newest_t_ns], item.t_ns)))[:-1]
        if new.any():
            self._newest_t_ns = int(item.t_ns[new][-1])
        if self._core is not None:
            return self._core.step(item)
        return [_without_twin(select(item, new))] if new.any() else []

    def tick(self, now_ns: int) -> Sequence[Message]:
        """What the core of the twin in force emits."""
        return self._core.tick(now_ns) if self._core else []

    def counters(self) -> Mapping[str, int]:
        """Of all twins so far."""
        return self._counts + Counter(self._core.counters() if self._core else {})

    def problem(self) -> str:
        """A twin that could not take over, or what is wrong with the one in force."""
        return self._problem or (self._core.problem() if self._core else "")

    def _take_over(self, first_t_ns: int) -> None:
        new, self._next = self._next, None
        if new is None or new.sha256 == self._sha256:
            return
        try:
            twin = learned_twin(self._tray, new.twin, new.content)
        except StageError as error:
            self._problem = f"{new.twin} did not take over: {error}"
            return
        if self._core:
            self._counts.update(self._core.counters())
        self._core, self._sha256, self._problem = self._core_of(twin, first_t_ns, new.content), new.sha256, ""


def _without_twin(grid: Grid) -> Prediction:
    unknown = np.full(grid.command.shape, np.nan)
    sigma = np.full(grid.fans, np.nan)
    return Prediction(
        fans=grid.fans,
        period_ns=grid.period_ns,
        t_ns=grid.t_ns,
        command=grid.command,
        measured_speed_rad_s=grid.speed_rad_s,
        predicted_speed_rad_s=unknown,
        sigma_rad_s=sigma,
        valid=np.zeros(grid.command.shape, np.bool_),
        invalid_reason=np.where(grid.valid, InvalidReason.NO_TWIN, grid.invalid_reason).astype(np.uint8),
        torque_balance_command=unknown,
        torque_balance_sigma_command=sigma,
        reading_missing=grid.reading_missing,
    )
