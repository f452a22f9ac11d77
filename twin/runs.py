"""Measured runs: command in, speed out, for one or many fans on one clock.

Units: time in seconds, speed in rad/s, command in whatever unit the caller uses (duty, volts, percent, counts).
A speed of NaN is a missing sample; a command is never missing, because the twin is driven by it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fantwin.schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan
from fantwin.twin.errors import TwinError

Array = NDArray[np.float64]

GAP_IN_MEDIAN_PERIODS = 5.0
STARTING_SAMPLES = 5


@dataclass(frozen=True, eq=False)
class Run:
    """One uninterrupted recording.

    t_s: (n,) strictly increasing, irregular steps allowed. command: (n, fans), held from its sample to the next.
    speed_rad_s: (n, fans) readings, NaN where missing. One-dimensional command and speed mean a single fan.
    tacho: of each fan what its readings are of its speed; one that all have in common is repeated. auxiliary: what else
    was measured, (n, fans) each, NaN where not, by name: supply_voltage_v, temperature_c and others that are not used.
    Raises TwinError when the shapes disagree, time does not increase, or a time or command is not finite.
    """

    name: str
    t_s: Array
    command: Array
    speed_rad_s: Array
    tacho: tuple[Tacho, ...] = INSTANTANEOUS
    auxiliary: Mapping[str, Array] = field(default_factory=dict[str, Array])

    def __post_init__(self) -> None:
        t_s = np.array(self.t_s, dtype=np.float64)
        command = _columns(self.command)
        speed_rad_s = _columns(self.speed_rad_s)
        if t_s.ndim != 1 or command.ndim != 2 or command.shape != speed_rad_s.shape or len(t_s) != len(command):
            raise TwinError(
                f"run {self.name!r}: time {t_s.shape}, command {command.shape} and speed {speed_rad_s.shape} disagree; "
                "give (n,), (n, fans) and (n, fans)"
            )
        if len(t_s) < 2 or command.shape[1] == 0:
            raise TwinError(f"run {self.name!r}: {len(t_s)} samples of {command.shape[1]} fans; give 2 samples or more")
        if not np.all(np.isfinite(t_s)) or not np.all(np.isfinite(command)):
            raise TwinError(f"run {self.name!r}: a time or command is not a number; only speeds may be missing (NaN)")
        if not np.all(np.diff(t_s) > 0.0):
            sample = int(np.argmin(np.diff(t_s) > 0.0)) + 1
            raise TwinError(
                f"run {self.name!r}: time does not increase at sample {sample}; merge samples of one time, "
                "or split the recording where its clock jumps back"
            )
        if np.any(np.isinf(speed_rad_s)):
            raise TwinError(f"run {self.name!r}: a speed is infinite; mark missing speeds with NaN")
        for name, value in (("t_s", t_s), ("command", command), ("speed_rad_s", speed_rad_s)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        try:
            object.__setattr__(self, "tacho", tacho_of_each_fan(self.tacho, command.shape[1]))
        except ValueError as error:
            raise TwinError(f"run {self.name!r}: {error}") from error

    @property
    def samples(self) -> int:
        """The number of samples."""
        return len(self.t_s)

    @property
    def fans(self) -> int:
        """The number of fans."""
        return self.command.shape[1]

    @property
    def duration_s(self) -> float:
        """Time from the first sample to the last."""
        return float(self.t_s[-1] - self.t_s[0])

    @property
    def median_period_s(self) -> float:
        """The typical time between samples."""
        return float(np.median(np.diff(self.t_s)))

    @property
    def step_s(self) -> Array:
        """(n,) time from each sample to the next; the last one, whose next is unknown, repeats the one before."""
        steps = np.diff(self.t_s)
        return np.append(steps, steps[-1])

    def fan(self, index: int) -> "Run":
        """The run of one fan alone."""
        column = slice(index, index + 1)
        return replace(
            self,
            command=self.command[:, column],
            speed_rad_s=self.speed_rad_s[:, column],
            tacho=self.tacho[column],
            auxiliary={name: of[:, column] for name, of in self.auxiliary.items()},
        )

    def between(self, start_s: float, stop_s: float) -> "Run":
        """The samples with start_s <= t_s < stop_s."""
        first, last = np.searchsorted(self.t_s, (start_s, stop_s))
        return self.rows(int(first), int(last))

    def rows(self, first: int, last: int) -> "Run":
        """The samples first <= k < last."""
        part = slice(first, last)
        return replace(
            self,
            t_s=self.t_s[part],
            command=self.command[part],
            speed_rad_s=self.speed_rad_s[part],
            auxiliary=self.auxiliary_in(part),
        )

    def auxiliary_in(self, rows: slice | NDArray[np.intp]) -> dict[str, Array]:
        """The auxiliary columns in some rows."""
        return {name: of[rows] for name, of in self.auxiliary.items()}

    def equal_parts(self, max_samples: int) -> list[tuple[int, int]]:
        """First and last row, for rows(), of about equal parts of at most max_samples; a lone sample is left out."""
        count = -(-self.samples // max_samples)
        cuts = np.linspace(0, self.samples, count + 1).astype(int).tolist()
        return [(first, last) for first, last in pairwise(cuts) if last - first >= 2]

    def split_at_gaps(self) -> list["Run"]:
        """The stretches between steps longer than five median ones.

        A held command says nothing about a long gap. Stretches of a single sample hold no step and are left out.
        """
        limit_s = GAP_IN_MEDIAN_PERIODS * self.median_period_s
        cuts = [0, *(np.flatnonzero(np.diff(self.t_s) > limit_s) + 1).tolist(), self.samples]
        spans = [(first, last) for first, last in pairwise(cuts) if last - first >= 2]
        return [self.rows(first, last) for first, last in spans]


def common_fans(runs: Sequence[Run]) -> int:
    """The number of fans that all runs share. Raises TwinError when there are no runs or they differ."""
    if not runs:
        raise TwinError("no runs given; give at least one")
    fans = {run.fans for run in runs}
    if len(fans) > 1:
        raise TwinError(f"runs of {sorted(fans)} fans are mixed; give runs of one fan count")
    return fans.pop()


def common_tacho(runs: Sequence[Run]) -> tuple[Tacho, ...]:
    """(fans,) the tachos that all runs share; none without runs. Raises TwinError when runs differ in them."""
    if not runs:
        return ()
    first = runs[0]
    for run in runs:
        for fan, (one, other) in enumerate(zip(first.tacho, run.tacho, strict=False)):
            if one != other:
                raise TwinError(
                    f"fan {fan}: measured by {one} in run {first.name!r}, and by {other} in run {run.name!r}: "
                    "give runs that are measured alike"
                )
    return first.tacho


def starting_samples(t_s: Array, speed_rad_s: Array, tacho: Sequence[Tacho]) -> NDArray[np.bool_]:
    """(n, batch) the first five readings that show mostly the time after the start. t_s, speed_rad_s: (n, batch)."""
    after_start = np.isfinite(speed_rad_s) & (t_s - t_s[0] >= [each.mean_delay_s for each in tacho])
    return after_start & (np.cumsum(after_start, axis=0) <= STARTING_SAMPLES)


def starting_speed_rad_s(speed_rad_s: Array, early: NDArray[np.bool_] | None = None) -> Array:
    """(fans,) mean of the first five measured speeds of (n, fans), or of the `early` ones; NaN for a fan without."""
    if early is None:
        measured = np.isfinite(speed_rad_s)
        early = measured & (np.cumsum(measured, axis=0) <= STARTING_SAMPLES)
    columns = zip(speed_rad_s.T, early.T, strict=True)
    return np.array([column[wanted].mean() if wanted.any() else np.nan for column, wanted in columns])


def _columns(values: ArrayLike) -> Array:
    array = np.array(values, dtype=np.float64)
    return array[:, np.newaxis] if array.ndim == 1 else array
