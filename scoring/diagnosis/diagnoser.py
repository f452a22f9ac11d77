"""When a fan is diagnosed, and on what: its last seconds, at the raise of an alarm and again as evidence grows."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.messages import Array
from schemas.messages import Diagnosis as Told
from schemas.units import NS_PER_S
from scoring.diagnosis.diagnosis import diagnose
from scoring.diagnosis.regression_window import HealthyBalance, Window
from scoring.limits import summed_deviation

WINDOW_S = 95.0
AGAIN_AFTER_S = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)  # after the raise; the last with some health before it
MOST_SAMPLES = 1 << 16  # of a fan are looked at: at a very fast rate, the last of the seconds
LARGEST = 1e9  # a speed or a command beyond is none, and its powers would be no numbers
LEAST_PROBABILITY = 0.005  # less is not worth telling


@dataclass(frozen=True, eq=False)
class _Block:
    t_ns: Array
    command: Array
    speed_rad_s: Array
    offset_command: Array
    offset_s: Array
    usual_command: Array


class Diagnoser:
    """Of one tray's fans. Gives the same however samples are cut into blocks: it looks at rows by their time."""

    def __init__(self, healthy: Sequence[HealthyBalance]) -> None:
        self._healthy = healthy
        self._blocks: deque[_Block] = deque()
        self._step_ns = 0
        self._due: dict[int, list[int]] = {}
        self._onset_t_ns: dict[int, int] = {}

    def take(
        self,
        t_ns: Array,
        period_ns: int,
        command: Array,
        speed_rad_s: Array,
        offset_command: Array,
        offset_s: Array | float = math.inf,
        usual_command: Array | float = 0.0,
    ) -> None:
        """Keep a block, (n, fans) each but t_ns, (n,). command: NaN where it is not known. offset_command: what of the
        balance is the fan's own. offset_s: of how many seconds of healthy running that is known. usual_command: what
        the healthy balance is at these speeds beside that, NaN where they are not known.
        """
        if period_ns != self._step_ns:
            self._blocks.clear()
            self._step_ns = period_ns
        offset_s, usual_command = (np.broadcast_to(one, offset_command.shape) for one in (offset_s, usual_command))
        self._blocks.append(_Block(t_ns, command, speed_rad_s, offset_command, offset_s, usual_command))
        oldest_t_ns = int(t_ns[0]) - min(round(WINDOW_S * NS_PER_S), MOST_SAMPLES * period_ns)
        while int(self._blocks[0].t_ns[-1]) < oldest_t_ns:
            self._blocks.popleft()

    def raised(self, fan: int, t_ns: int, onset_t_ns: int) -> None:
        """An alarm was raised: from now on it is diagnosed again and again."""
        self._due[fan] = [t_ns + round(after_s * NS_PER_S) for after_s in AGAIN_AFTER_S]
        self._onset_t_ns[fan] = onset_t_ns

    def cleared(self, fan: int) -> None:
        """It was cleared: no more of it."""
        self._due.pop(fan, None)

    def due(self, t_ns: Array) -> list[tuple[int, int]]:
        """Rows of the block at which fans are to be diagnosed again, (row, fan) in order; each is given once."""
        found: set[tuple[int, int]] = set()  # where samples are missing, several times fall on one row
        for fan, times in list(self._due.items()):
            while times and times[0] <= t_ns[-1]:
                found.add((int(np.searchsorted(t_ns, times.pop(0))), fan))
            if not times:
                del self._due[fan]
        return sorted(found)

    def diagnose(self, fan: int, t_ns: int) -> tuple[Told, ...]:
        """The causes by what was known at t_ns, a time of a sample taken; the most probable first."""
        window = self.window(fan, t_ns, self._onset_t_ns.get(fan, t_ns))
        if window is None:
            return ()
        suspects = diagnose(window, self._healthy[fan]).suspects
        return tuple(
            Told(
                cause=suspect.cause,
                probability=suspect.probability,
                parameter=suspect.evidence.parameter if suspect.evidence else "",
                change=suspect.evidence.change if suspect.evidence else 0.0,
                change_low=suspect.evidence.low if suspect.evidence else 0.0,
                change_high=suspect.evidence.high if suspect.evidence else 0.0,
                unit=suspect.evidence.unit if suspect.evidence else "",
                evidence=suspect.sentence,
            )
            for suspect in suspects
            if suspect.probability >= LEAST_PROBABILITY
        )

    def snapshot(self) -> dict[str, Any]:
        """What is still to be done, as JSON can hold it; the samples themselves are not kept."""
        return {
            "due": {str(fan): times for fan, times in self._due.items()},
            "onset_t_ns": {str(fan): onset for fan, onset in self._onset_t_ns.items()},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a snapshot.

        Raises:
            ValueError, KeyError: it is not one.
        """
        self._due = {int(fan): [int(t) for t in times] for fan, times in state["due"].items()}
        self._onset_t_ns = {int(fan): int(onset) for fan, onset in state["onset_t_ns"].items()}
        if not all(0 <= fan < len(self._healthy) for fan in (*self._due, *self._onset_t_ns)):
            raise ValueError("a fan that is not there")

    def window(self, fan: int, t_ns: int, onset_t_ns: int, seconds: float = WINDOW_S) -> Window | None:
        """The last seconds, at most WINDOW_S, of a fan up to t_ns; None where there are none."""
        first_t_ns = t_ns - min(round(seconds * NS_PER_S), MOST_SAMPLES * self._step_ns)
        blocks = [block for block in self._blocks if first_t_ns < block.t_ns[-1] and block.t_ns[0] <= t_ns]
        if not blocks:
            return None
        times = np.concatenate([block.t_ns for block in blocks])
        rows = (times > first_t_ns) & (times <= t_ns)
        if np.count_nonzero(rows) < 2:
            return None
        times = times[rows]
        place = np.rint((times - times[0]) / self._step_ns).astype(int)
        if place[-1] < 1:
            return None
        command, speed = np.full(place[-1] + 1, np.nan), np.full(place[-1] + 1, np.nan)
        usual = np.full(place[-1] + 1, np.nan)
        command[place] = _kept(blocks, "command", fan, rows)
        speed[place] = _kept(blocks, "speed_rad_s", fan, rows)
        usual[place] = _kept(blocks, "usual_command", fan, rows)
        healthy, step_s = self._healthy[fan], self._step_ns / NS_PER_S
        of_a_second = healthy.sigma_command * summed_deviation(healthy.autocorrelation_time_s, step_s)
        for values in (command, speed):
            values[np.abs(values) > LARGEST] = np.nan
        onset = int(np.searchsorted(times, onset_t_ns))
        return Window(
            step_s=step_s,
            command=command,
            speed_rad_s=speed,
            onset=int(place[min(onset, len(place) - 1)]),
            usual=usual,
            offset=float(_kept(blocks, "offset_command", fan, rows)[-1]),
            offset_std_error=of_a_second / math.sqrt(max(_kept(blocks, "offset_s", fan, rows)[-1], step_s)),
        )


def _kept(blocks: Sequence[_Block], column: str, fan: int, rows: Array) -> Array:
    return np.concatenate([getattr(block, column)[:, fan] for block in blocks])[rows]
