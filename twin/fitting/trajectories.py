"""Runs cut into many short free runs that are integrated side by side.

Time is the only axis that has to be processed in order, so fitting cuts runs into stretches of a few time constants and
treats stretches and fans alike as one batch. Each stretch has its own initial speed. A tacho that averages shows at
first the time before: a stretch that continues another begins earlier by that time, which is not compared again.

Not everything needs all readings of many fans: `windows_of` and `coarser` give fewer.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fantwin.schemas.tacho import Tacho
from fantwin.twin.errors import TwinError
from fantwin.twin.runs import Array, Run, common_tacho, starting_samples, starting_speed_rad_s
from fantwin.twin.tacho_readings import Measurement

MIN_SAMPLES = 200
MAX_SAMPLES = 12_000
MAX_PADDED = 4
ROUNDING_S = 1e-6


@dataclass(frozen=True, eq=False)
class Trajectories:
    """A batch of stretches, padded at the end to one length.

    fan: (batch,) which fan each stretch belongs to. command, speed_rad_s, step_s: (n, batch). Padding has a step of
    zero, which leaves the state where it is, and a speed of NaN, which counts as missing. command_before: (batch,), the
    command in force before each stretch, which stands for the lagged one: a lag is short beside a stretch.
    tacho: of each fan. lead_in: (batch,) so many first samples belong to the stretch before.
    """

    fan: NDArray[np.intp]
    command_before: Array
    command: Array
    speed_rad_s: Array
    step_s: Array
    tacho: tuple[Tacho, ...]
    lead_in: NDArray[np.intp]

    @cached_property
    def measurement(self) -> Measurement:
        """From the speeds of the stretches to the readings that are expected."""
        start = np.zeros((1, len(self.fan)))
        t_s = np.concatenate((start, np.cumsum(self.step_s[:-1], axis=0)))
        return Measurement(t_s, [self.tacho[fan] for fan in self.fan.tolist()])

    @cached_property
    def compared(self) -> NDArray[np.bool_]:
        """(n, batch) which readings a free run is compared with."""
        own = np.arange(len(self.speed_rad_s))[:, np.newaxis] >= self.lead_in
        return np.isfinite(self.speed_rad_s) & self.measurement.comparable & own

    @cached_property
    def early(self) -> NDArray[np.bool_]:
        """(n, batch) the readings that a free run starts from (twin.runs.starting_samples)."""
        return starting_samples(self.measurement.t_s, self.speed_rad_s, self.measurement.tacho)

    def rms_of_fans(self, values: Array) -> Array:
        """(fans,) root mean square of values (n, batch) over the readings that are compared."""
        fans = len(self.tacho)
        squares = np.bincount(self.fan, np.sum(values**2, axis=0, where=self.compared), fans)
        return np.sqrt(squares / np.bincount(self.fan, self.compared.sum(axis=0), fans))

    def thinned(self, max_samples: int) -> "Trajectories":
        """Some of the stretches, always the same ones of a random choice, with at most about max_samples in all."""
        count = min(len(self.fan), max(1, max_samples // len(self.command)))
        return self.of_columns(np.sort(np.random.default_rng(0).permutation(len(self.fan))[:count]))

    def of_columns(self, chosen: NDArray[np.intp]) -> "Trajectories":
        """The stretches with these indices."""
        names = ("fan", "command_before", "command", "speed_rad_s", "step_s", "lead_in")
        return replace(self, **{name: getattr(self, name)[..., chosen] for name in names})

    def first_samples(self, count: int) -> "Trajectories":
        """The first samples of all stretches, so many of each."""
        return replace(
            self, command=self.command[:count], speed_rad_s=self.speed_rad_s[:count], step_s=self.step_s[:count]
        )

    def interpolated_speed_rad_s(self) -> Array:
        """(n, batch) the speeds, the missing ones interpolated: a first guess of a free run."""
        samples = np.arange(len(self.speed_rad_s))
        measured = np.isfinite(self.speed_rad_s)
        columns = [
            np.interp(samples, samples[known], speed[known])
            for speed, known in zip(self.speed_rad_s.T, measured.T, strict=True)
        ]
        return np.stack(columns, axis=1)

    def starting_speed_rad_s(self) -> Array:
        """(batch,) mean of the first measured speeds of each stretch."""
        return starting_speed_rad_s(self.speed_rad_s, self.early)


def cut_into_trajectories(runs: Sequence[Run], max_samples: int) -> Trajectories:
    """Every fan of every run, in equal stretches of at most max_samples, and before each what its first readings show.

    Stretches without two speeds are left out. The runs must not hold gaps (Run.split_at_gaps) and must be measured
    alike. Raises TwinError when nothing is left.
    """
    tacho = common_tacho(runs)
    reach_s = max((each.reach_s for each in tacho), default=0.0)
    parts = [
        (run, _begin(run, first, reach_s), first, last) for run in runs for first, last in run.equal_parts(max_samples)
    ]
    length = max((last - begin for _, begin, _, last in parts), default=0)
    fans = len(tacho)
    shape = (length, len(parts), fans)
    command, step_s, speed = np.zeros(shape), np.zeros(shape), np.full(shape, np.nan)
    before = np.zeros(shape[1:])
    for index, (run, begin, _, last) in enumerate(parts):
        part = run.rows(begin, last)
        command[: part.samples, index] = part.command
        speed[: part.samples, index] = part.speed_rad_s
        step_s[: part.samples - 1, index] = part.step_s[:-1, np.newaxis]
        before[index] = run.command[max(begin - 1, 0)]
    flat = (length, len(parts) * fans)
    everything = Trajectories(
        fan=np.tile(np.arange(fans), len(parts)),
        command_before=before.ravel(),
        command=command.reshape(flat),
        speed_rad_s=speed.reshape(flat),
        step_s=step_s.reshape(flat),
        tacho=tacho,
        lead_in=np.repeat([first - begin for _, begin, first, _ in parts], fans),
    )
    usable = np.flatnonzero(everything.compared.sum(axis=0) >= 2)
    if not usable.size:
        raise TwinError("the runs hold no stretch with two measured speeds; check the speed column")
    return everything.of_columns(usable)


def _begin(run: Run, first: int, reach_s: float) -> int:
    """The last sample from which on sample `first` shows nothing of the time before; 0 where there is none."""
    if reach_s == 0.0:
        return first
    return int(max(np.searchsorted(run.t_s, run.t_s[first] - reach_s - ROUNDING_S, side="right") - 1, 0))


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


ENOUGH_READINGS = 64_000
"""of all fans together: eight fans at 100 Hz for 80 s"""
LEAST_FANS = 5
"""that a window shows; so the runs of fewer than ten fans are used as they are"""
TIME_CONSTANTS = 15.0
"""of a window"""
COARSE_TIME_CONSTANTS = 0.25
"""between two samples of `coarser`, at most"""


def thinning_factor(pieces: Sequence[Run], time_constant_s: float) -> int:
    """A window shows one fan of so many; 1 where the fans are few, or their readings.

    pieces: of runs, without gaps. time_constant_s: of the slowest fan.
    """
    readings = sum(int(np.count_nonzero(np.isfinite(piece.speed_rad_s))) for piece in pieces)
    windows = sum(piece.samples for piece in pieces) // _window_samples(pieces, time_constant_s)
    return max(1, min(readings // ENOUGH_READINGS, pieces[0].fans // LEAST_FANS, windows))


def windows_of(pieces: Sequence[Run], time_constant_s: float) -> list[Run]:
    """Windows of pieces of runs, or the pieces themselves where the factor is 1. Arguments as of thinning_factor.

    A network of a few dozen weights is as well determined by the readings of a few fans as by those of many. So the
    runs of many fans are cut into windows, and of each window only the readings of every n-th fan are kept, n the
    factor; of the next fan in the next window. The readings that a window does not show are NaN. Whatever happens in a
    run is still seen at some fans, and every fan is seen in some windows. (Fans of a tray are often commanded alike:
    with whole runs of some fans, or the same moments of all, a start or a level might be missing.)
    """
    every = thinning_factor(pieces, time_constant_s)
    if every == 1:
        return list(pieces)
    length = _window_samples(pieces, time_constant_s)
    cut = [piece.rows(first, last) for piece in pieces for first, last in piece.equal_parts(length)]
    fans = np.arange(pieces[0].fans)
    return [
        replace(window, speed_rad_s=np.where(fans % every == number % every, window.speed_rad_s, np.nan))
        for number, window in enumerate(cut)
    ]


def _window_samples(pieces: Sequence[Run], time_constant_s: float) -> int:
    return stretch_samples(time_constant_s, min(piece.median_period_s for piece in pieces), TIME_CONSTANTS)


def coarser(piece: Run, time_constant_s: float) -> Run:
    """The piece with a sample for each share of a time constant, or as it is where its samples are that far apart.

    What is known of a single fan comes from this, since it cannot come from the few windows of that fan.
    A sample is the mean of the readings of its share, at the time of the middle one, and the mean of the commands from
    there to the next.
    """
    every = int(COARSE_TIME_CONSTANTS * time_constant_s / piece.median_period_s)
    every -= 1 - every % 2
    count = piece.samples // every - 1 if every > 1 else 0
    if count < 2:
        return piece
    middle = every // 2
    speed = piece.speed_rad_s[: count * every].reshape(count, every, -1)
    measured = np.isfinite(speed)
    readings = measured.sum(axis=1)
    total: Array = np.sum(speed, axis=1, where=measured)
    mean = np.divide(total, readings, out=np.full_like(total, np.nan), where=readings > 0)
    command = piece.command[middle : middle + count * every].reshape(count, every, -1).mean(axis=1)
    return replace(piece, t_s=piece.t_s[middle : count * every : every], command=command, speed_rad_s=mean)
