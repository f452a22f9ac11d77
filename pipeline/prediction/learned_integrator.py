"""The twin integrator of a tray whose twin is learned while it runs: a core for each version, one at a time.

A twin that has just been learned takes over between two blocks, at the first sample that is newer than all before it.
Its card, which is published then, carries the twin and the time of that sample. So a replay changes the twin at the
same sample: it publishes the twin in advance, with the time of its first sample, and the block is cut before that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.prediction.new_samples import BEGINNING_NS, NewSamples, are_newer
from fantwin.pipeline.prediction.twin_file import TwinFile, learned_twin
from fantwin.pipeline.runtime.stage import Core, StageError
from fantwin.schemas.blocks import cut
from fantwin.schemas.channels import measured_columns
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Grid, Message, NewTwin, Prediction

MOST_COMING = 8
"""twins that wait for their first samples; a replay publishes one in advance"""


class LearnedTwinIntegrator(Core):
    """Predicts by the newest twin it has received; without one, no sample is valid (NO_TWIN)."""

    def __init__(self, tray: TrayConfig, core_of: Callable[[TwinFile, int, bytes], Core]) -> None:
        """core_of: the core of a twin, from its first sample (time in ns) on, and the content of its file."""
        self._tray = tray
        self._core_of = core_of
        self._core: Core | None = None
        self._sha256 = ""
        """hash of the twin in force"""
        self._coming: list[NewTwin] = []
        """those that are to take over, in the order of their first samples"""
        self._samples = NewSamples(tray.fans, "grid samples", "twin_integrator and scorer")
        self._counts: Counter[str] = Counter()
        """counters of the twins before the current one"""
        self._problem = ""

    def step(self, item: Grid | NewTwin) -> Sequence[Message]:
        """Predict the speeds of a block, or receive the twin for those to come."""
        if isinstance(item, NewTwin):
            before = [each for each in self._coming if _first_t_ns(each) < _first_t_ns(item)]
            self._coming = [*before, item][-MOST_COMING:]
            return []
        if self._core is None and not self._samples.fits(item):
            return []
        return [message for block in self._cut(item) for message in self._predict(block)]

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Messages of the twin in force."""
        return self._core.tick(now_ns) if self._core else []

    def counters(self) -> Mapping[str, int]:
        """Counters of all twins so far."""
        return self._counts + Counter(self._counting.counters())

    def notes(self) -> Sequence[str]:
        """Notes of the twin in force."""
        return self._core.notes() if self._core else ()

    def problem(self) -> str:
        """A twin that could not take over, or what is wrong with the one in force."""
        return self._problem or self._counting.problem()

    @property
    def _counting(self) -> Core | NewSamples:
        """The part that counts and reports samples now: the core of the twin in force, if there is one."""
        return self._core or self._samples

    def _cut(self, grid: Grid) -> Iterator[Grid]:
        """The block, cut before the first sample of each twin that names one in it."""
        named = [each.first_sample_t_ns for each in self._coming if each.first_sample_t_ns]
        if not named:
            yield grid
            return
        new = are_newer(grid.t_ns, self._samples.last_t_ns)
        rows = (np.flatnonzero(new & (grid.t_ns >= first_t_ns)) for first_t_ns in named)
        cuts = sorted({int(found[0]) for found in rows if len(found)} - {0})
        for begin, end in pairwise((0, *cuts, len(grid.t_ns))):
            yield cut(grid, begin, end)

    def _predict(self, grid: Grid) -> Sequence[Message]:
        """Predict a block by one twin."""
        if len(grid.t_ns) and grid.t_ns[0] > self._samples.last_t_ns:
            self._take_over(int(grid.t_ns[0]))
        new = self._samples.take(grid)
        if self._core is not None:
            return self._core.step(grid)
        return [_without_twin(new)] if new is not None else []

    def _take_over(self, first_t_ns: int) -> None:
        """Change to the newest twin whose first sample has come."""
        due = [each for each in self._coming if _first_t_ns(each) <= first_t_ns]
        if not due:
            return
        self._coming = [each for each in self._coming if each not in due]
        new = due[-1]
        if new.sha256 == self._sha256:
            return
        try:
            twin = learned_twin(self._tray, new.twin, new.content)
        except StageError as error:
            self._problem = f"{new.twin} did not take over: {error}"
            return
        self._counts.update(self._counting.counters())
        self._core, self._sha256, self._problem = self._core_of(twin, first_t_ns, new.content), new.sha256, ""


def _first_t_ns(new: NewTwin) -> int:
    return new.first_sample_t_ns or BEGINNING_NS


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
        reading_repeated=grid.reading_repeated,
        **measured_columns(grid),
    )
