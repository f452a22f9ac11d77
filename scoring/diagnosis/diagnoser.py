"""Diagnoses fans on their last seconds: when an alarm is raised, and again as evidence grows."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.messages import Array
from schemas.messages import Diagnosis as CauseMessage
from schemas.standstill import Standstill
from schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan
from schemas.units import NS_PER_S
from scoring.detectors.deviation import summed_deviation
from scoring.diagnosis.advice import Advice
from scoring.diagnosis.diagnosis import ADVICE, RankedCause, diagnose
from scoring.diagnosis.regression_window import HealthyBalance, Window
from scoring.diagnosis.shown_causes import MIN_PROBABILITY, is_of_standstill
from scoring.diagnosis.standstill_causes import coming_to_rest, standstill_causes

WINDOW_S = 95.0
AGAIN_AFTER_S = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)  # after the raise; the last window still contains some health
MAX_SAMPLES = 1 << 16  # of a fan's window; at very high rates the window is shorter than WINDOW_S
MAX_VALUE = 1e9  # larger speeds and commands count as missing: their powers would overflow
NEWS = 0.1  # a change of a probability that is worth a message


_NOT_KNOWN = np.zeros(0, np.bool_)
_NOT_MEASURED = np.zeros(0)


@dataclass(frozen=True, eq=False)
class _Block:
    t_ns: Array
    command: Array
    speed_rad_s: Array
    offset_command: Array
    offset_s: Array
    expected_command: Array
    expected_rad_s: Array
    reading_missing: Array
    """(n, fans) of bool; empty where the line does not tell"""
    supply_voltage_v: Array
    """(n, fans), as the next; empty where it is not measured"""
    current_a: Array
    given_command: Array
    """(n, fans); empty where `command` is as it was given"""


class Diagnoser:
    """Diagnoses the fans of one tray. Rows are selected by time: the cuts between blocks make no difference."""

    def __init__(
        self,
        healthy: Sequence[HealthyBalance],
        advice: Advice = ADVICE,
        tachos: Sequence[Tacho] = INSTANTANEOUS,
        standstill: Standstill | None = None,
        *,
        knows_supply: bool = False,
    ) -> None:
        """advice, knows_supply: see `diagnose`. standstill: None where the detector of it is not used."""
        self._healthy = healthy
        self._advice = advice
        self._tachos = tacho_of_each_fan(tachos, len(healthy))
        self._standstill = standstill
        self._knows_supply = knows_supply
        self._blocks: deque[_Block] = deque()
        self._period_ns = 0
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
        expected_command: Array | float = 0.0,
        expected_rad_s: Array | float = math.nan,
        reading_missing: Array = _NOT_KNOWN,
        supply_voltage_v: Array = _NOT_MEASURED,
        current_a: Array = _NOT_MEASURED,
        given_command: Array = _NOT_MEASURED,
    ) -> None:
        """Store a block; t_ns (n,), the others (n, fans).

        command: NaN where unknown. offset_command: the fan's own offset of the torque balance. offset_s: seconds of
        healthy running from which the offset is known. expected_command: the expected healthy balance at
        this speed, apart from the offset; NaN where the speed is unknown. expected_rad_s: what a healthy fan would
        read. reading_missing: where the newest raw sample had no reading; empty where the line does not tell.
        supply_voltage_v, current_a: empty where it is not measured. given_command: as the fans were given it; empty
        where `command` is not converted to reference conditions.
        """
        if period_ns != self._period_ns:
            self._blocks.clear()
            self._period_ns = period_ns
        offset_s, expected, reading = (
            np.broadcast_to(one, offset_command.shape) for one in (offset_s, expected_command, expected_rad_s)
        )
        self._blocks.append(
            _Block(
                t_ns,
                command,
                speed_rad_s,
                offset_command,
                offset_s,
                expected,
                reading,
                reading_missing,
                supply_voltage_v,
                current_a,
                given_command,
            )
        )
        oldest_t_ns = int(t_ns[0]) - min(round(WINDOW_S * NS_PER_S), MAX_SAMPLES * period_ns)
        while int(self._blocks[0].t_ns[-1]) < oldest_t_ns:
            self._blocks.popleft()

    def raised(self, fan: int, t_ns: int, onset_t_ns: int) -> None:
        """An alarm was raised: schedule the diagnoses that follow."""
        self._due[fan] = [t_ns + round(after_s * NS_PER_S) for after_s in AGAIN_AFTER_S]
        self._onset_t_ns[fan] = onset_t_ns

    def cleared(self, fan: int) -> None:
        """The alarm was cleared: cancel the diagnoses that are left."""
        self._due.pop(fan, None)

    def due(self, t_ns: Array) -> list[tuple[int, int]]:
        """Rows of the block at which fans are due for a diagnosis, as sorted (row, fan); each is returned once."""
        found: set[tuple[int, int]] = set()  # several times fall on one row where samples are missing
        for fan, times in list(self._due.items()):
            while times and times[0] <= t_ns[-1]:
                found.add((int(np.searchsorted(t_ns, times.pop(0))), fan))
            if not times:
                del self._due[fan]
        return sorted(found)

    def diagnose(self, fan: int, t_ns: int) -> tuple[CauseMessage, ...]:
        """The causes from the samples up to t_ns, the most probable first. t_ns: time of a stored sample."""
        window = self.window(fan, t_ns, self._onset_t_ns.get(fan, t_ns))
        if window is None:
            return ()
        causes = diagnose(
            window, self._healthy[fan], self._advice, self._tachos[fan], knows_supply=self._knows_supply
        ).causes
        if self._standstill is not None:
            rest = coming_to_rest(window, self._standstill, self._healthy[fan], self._tachos[fan])
            causes = rest.beside(causes) if rest else causes
        least = min(MIN_PROBABILITY, causes[0].probability)
        return tuple(_message(cause) for cause in causes if cause.probability >= least)

    def says_more(self, causes: Sequence[CauseMessage], than: Sequence[CauseMessage]) -> bool:
        """Whether causes are worth a message after others: in another order, or with other probabilities.

        A fan that did not turn and turns again has recovered: causes found from then on are of the fault's end.
        """
        stood, stands = (bool(each) and is_of_standstill(each[0]) for each in (than, causes))
        if stood and not stands:
            return False
        if stands != stood or [each.cause for each in causes] != [each.cause for each in than]:
            return True
        return any(abs(new.probability - old.probability) >= NEWS for new, old in zip(causes, than, strict=True))

    def of_standstill(self, fan: int, t_ns: int) -> tuple[CauseMessage, ...]:
        """The causes of a fan that does not turn or stop as commanded, as `diagnose`."""
        window = self.window(fan, t_ns, self._onset_t_ns.get(fan, t_ns))
        if window is None or self._standstill is None:
            return ()
        causes = standstill_causes(window, self._standstill, self._healthy[fan], self._tachos[fan])
        return tuple(_message(cause) for cause in causes if cause.probability >= MIN_PROBABILITY)

    def snapshot(self) -> dict[str, Any]:
        """The scheduled diagnoses, as JSON values; the samples are not included."""
        return {
            "due": {str(fan): times for fan, times in self._due.items()},
            "onset_t_ns": {str(fan): onset for fan, onset in self._onset_t_ns.items()},
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a snapshot.

        Raises:
            ValueError, KeyError: it is not such a snapshot.
        """
        self._due = {int(fan): [int(t) for t in times] for fan, times in snapshot["due"].items()}
        self._onset_t_ns = {int(fan): int(onset) for fan, onset in snapshot["onset_t_ns"].items()}
        if not all(0 <= fan < len(self._healthy) for fan in (*self._due, *self._onset_t_ns)):
            raise ValueError("a fan that does not exist")

    def window(self, fan: int, t_ns: int, onset_t_ns: int, seconds: float = WINDOW_S) -> Window | None:
        """The last seconds of a fan up to t_ns, at most WINDOW_S; None where there are fewer than two samples."""
        first_t_ns = t_ns - min(round(seconds * NS_PER_S), MAX_SAMPLES * self._period_ns)
        blocks = [block for block in self._blocks if first_t_ns < block.t_ns[-1] and block.t_ns[0] <= t_ns]
        if not blocks:
            return None
        times = np.concatenate([block.t_ns for block in blocks])
        rows = (times > first_t_ns) & (times <= t_ns)
        if np.count_nonzero(rows) < 2:
            return None
        times = times[rows]
        index = np.rint((times - times[0]) / self._period_ns).astype(int)
        if index[-1] < 1:
            return None
        command, speed, expected, reading = np.full((4, index[-1] + 1), np.nan)
        command[index] = _column(blocks, "command", fan, rows)
        speed[index] = _column(blocks, "speed_rad_s", fan, rows)
        expected[index] = _column(blocks, "expected_command", fan, rows)
        reading[index] = _column(blocks, "expected_rad_s", fan, rows)
        for values in (command, speed):
            values[np.abs(values) > MAX_VALUE] = np.nan
        lacks = None
        if any(len(block.reading_missing) for block in blocks):
            lacks = np.zeros(index[-1] + 1, np.bool_)
            lacks[index] = np.concatenate([_lacks(block)[:, fan] for block in blocks])[rows]
        others: dict[str, Array | None] = {"supply_voltage_v": None, "current_a": None, "given_command": None}
        for name in others:
            if any(len(getattr(block, name)) for block in blocks):
                of_fan = others[name] = np.full(index[-1] + 1, np.nan)
                of_fan[index] = np.concatenate([_known_or_nan(block, name)[:, fan] for block in blocks])[rows]
        healthy, period_s = self._healthy[fan], self._period_ns / NS_PER_S
        std_of_one_second = healthy.sigma_command * summed_deviation(healthy.autocorrelation_time_s, period_s)
        offset_s = max(_column(blocks, "offset_s", fan, rows)[-1], period_s)
        onset = int(np.searchsorted(times, onset_t_ns))
        return Window(
            period_s=period_s,
            command=command,
            speed_rad_s=speed,
            onset=int(index[min(onset, len(index) - 1)]),
            expected_command=expected,
            expected_rad_s=reading,
            reading_missing=lacks,
            **others,
            fan_offset=float(_column(blocks, "offset_command", fan, rows)[-1]),
            fan_offset_std_error=std_of_one_second / math.sqrt(offset_s),
        )


def _column(blocks: Sequence[_Block], name: str, fan: int, rows: Array) -> Array:
    return np.concatenate([getattr(block, name)[:, fan] for block in blocks])[rows]


def _lacks(block: _Block) -> Array:
    return block.reading_missing if len(block.reading_missing) else ~np.isfinite(block.speed_rad_s)


def _known_or_nan(block: _Block, name: str) -> Array:
    values: Array = getattr(block, name)
    return values if len(values) else np.full(block.command.shape, np.nan)


def _message(cause: RankedCause) -> CauseMessage:
    change = cause.evidence
    if change is None:
        return CauseMessage(cause=cause.cause, probability=cause.probability, evidence=cause.sentence)
    return CauseMessage(
        cause=cause.cause,
        probability=cause.probability,
        parameter=change.parameter,
        change=change.change,
        unit=change.unit,
        evidence=cause.sentence,
    )
