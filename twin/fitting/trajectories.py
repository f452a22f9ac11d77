"""Runs cut into many short free runs that are integrated side by side.

Time is the only axis that has to be processed in order, so fitting cuts runs into stretches of a few time constants and
treats stretches and fans alike as one batch. Each stretch has its own initial speed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.errors import TwinError
from twin.runs import Array, Run, starting_speed_rad_s

MIN_SAMPLES = 200
MAX_SAMPLES = 12_000
MAX_PADDED = 4


@dataclass(frozen=True, eq=False)
class Trajectories:
    """A batch of stretches, padded at the end to one length.

    fan: (batch,) which fan each stretch belongs to. command, speed_rad_s, step_s: (n, batch). Padding has a step of
    zero, which leaves the state where it is, and a speed of NaN, which counts as missing. command_before: (batch,), the
    command in force before each stretch, which stands for the lagged one: a lag is short beside a stretch.
    """

    fan: NDArray[np.intp]
    command_before: Array
    command: Array
    speed_rad_s: Array
    step_s: Array

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(n, batch) which samples hold a measured speed."""
        return np.isfinite(self.speed_rad_s)

    def thinned(self, max_samples: int) -> "Trajectories":
        """Some of the stretches, always the same ones of a random choice, with at most about max_samples in all."""
        count = min(len(self.fan), max(1, max_samples // len(self.command)))
        chosen = np.sort(np.random.default_rng(0).permutation(len(self.fan))[:count])
        return Trajectories(
            self.fan[chosen],
            self.command_before[chosen],
            self.command[:, chosen],
            self.speed_rad_s[:, chosen],
            self.step_s[:, chosen],
        )

    def interpolated_speed_rad_s(self) -> Array:
        """(n, batch) the speeds, the missing ones interpolated: a first guess of a free run."""
        samples = np.arange(len(self.speed_rad_s))
        measured = self.measured
        columns = [
            np.interp(samples, samples[known], speed[known])
            for speed, known in zip(self.speed_rad_s.T, measured.T, strict=True)
        ]
        return np.stack(columns, axis=1)

    def starting_speed_rad_s(self) -> Array:
        """(batch,) mean of the first measured speeds of each stretch."""
        return starting_speed_rad_s(self.speed_rad_s)


def cut_into_trajectories(runs: Sequence[Run], max_samples: int) -> Trajectories:
    """Every fan of every run, in equal stretches of at most max_samples. Stretches without two speeds are left out.

    The runs must not hold gaps (Run.split_at_gaps). Raises TwinError when nothing is left.
    """
    parts = [(run, first, last) for run in runs for first, last in run.equal_parts(max_samples)]
    length = max((last - first for _, first, last in parts), default=0)
    fans = runs[0].fans if runs else 0
    shape = (length, len(parts), fans)
    command, step_s, speed = np.zeros(shape), np.zeros(shape), np.full(shape, np.nan)
    before = np.zeros(shape[1:])
    for index, (run, first, last) in enumerate(parts):
        part = run.rows(first, last)
        command[: part.samples, index] = part.command
        speed[: part.samples, index] = part.speed_rad_s
        step_s[: part.samples - 1, index] = part.step_s[:-1, np.newaxis]
        before[index] = run.command[max(first - 1, 0)]
    usable = np.flatnonzero(np.isfinite(speed).sum(axis=0).ravel() >= 2)
    if not usable.size:
        raise TwinError("the runs hold no stretch with two measured speeds; check the speed column")
    flat = (length, -1)
    return Trajectories(
        fan=np.tile(np.arange(fans), len(parts))[usable],
        command_before=before.ravel()[usable],
        command=command.reshape(flat)[:, usable],
        speed_rad_s=speed.reshape(flat)[:, usable],
        step_s=step_s.reshape(flat)[:, usable],
    )


def stretch_samples(time_constant_s: float, period_s: float, time_constants: float) -> int:
    """How many samples span a number of time constants, within bounds that keep the batch efficient."""
    return int(np.clip(time_constants * time_constant_s / period_s, MIN_SAMPLES, MAX_SAMPLES))


def practical_samples(runs: Sequence[Run], at_most: int) -> int:
    """The longest stretches whose padding does not exceed three times the samples themselves."""
    samples = at_most
    while samples > MIN_SAMPLES:
        counts = [-(-run.samples // samples) for run in runs]
        longest = max(-(-run.samples // count) for run, count in zip(runs, counts, strict=True))
        if sum(counts) * longest <= MAX_PADDED * sum(run.samples for run in runs):
            break
        samples //= 2
    return samples
