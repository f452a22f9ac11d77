"""Scores of a made-up fleet as they come off the bus: healthy fans of seeded noise, some of which get an alarm.

What they show does not depend on a twin or a scorer: a bench of what reads scores needs them cheap, and as many as a
data hall has.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bench.detection.plant import START_NS
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.enums import FanState, Severity, Statistic, Transition
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.fields import columns
from fantwin.schemas.header import Header, InputPosition
from fantwin.schemas.messages import Alarm, Array, Score
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S

SITE = "hall"
SIGMA_RAD_S = 2.0
ALARM_S, DELAY_S = 20.0, 0.5
"""how long an alarm is active, and how long before it, and before its end, a fan is suspect or returning"""
NOISES = 16
"""trays have one of so many noises"""


@dataclass(frozen=True)
class Excursion:
    """A fan that is slower than its twin from `onset_s` on; its alarm is raised `DELAY_S` later."""

    fan: Fan
    onset_s: float


class FleetScores:
    """A fleet of trays that send a message every `block_s`."""

    def __init__(
        self, fans: int, *, fans_of_tray: int = 64, rate_hz: float = 100.0, block_s: float = 0.05, seed: int = 1
    ) -> None:
        sizes = [min(fans_of_tray, fans - first) for first in range(0, fans, fans_of_tray)]
        self.trays = [
            TrayConfig(name=f"rack{number:03d}", fans=size, speed_unit="rpm") for number, size in enumerate(sizes, 1)
        ]
        self.fans = fans
        self.rate_hz = rate_hz
        self.block_s = block_s
        self.excursions: list[Excursion] = []
        self.gaps: set[str] = set()
        """trays whose samples are not judged"""
        self.silent: set[str] = set()
        """trays that send nothing"""
        random = np.random.default_rng(seed)
        self._length = round(block_s * rate_hz)
        self._noise = random.normal(0.0, SIGMA_RAD_S, (NOISES, round(rate_hz), fans_of_tray)).astype(np.float32)
        self._speed = random.uniform(280.0, 320.0, fans).astype(np.float32)
        self._level = random.gamma(2.5, 0.1, fans).clip(0.0, 0.97).astype(np.float32)

    def add_excursions(self, count: int, first_s: float, last_s: float, seed: int = 2) -> None:
        """Let `count` fans leave the band one after the other, evenly between two times."""
        random = np.random.default_rng(seed)
        of_site = [Fan(tray.name, number) for tray in self.trays for number in range(tray.fans)]
        chosen = random.choice(len(of_site), count, replace=False)
        onsets_s = np.linspace(first_s, last_s, count)
        self.excursions += [Excursion(of_site[i], float(at_s)) for i, at_s in zip(chosen, onsets_s, strict=True)]

    def second(self, number: int) -> list[Envelope | Alarm]:
        """What is sent within a second, in the order of its time; the first second is 0."""
        found: list[tuple[float, Envelope | Alarm]] = [*self._alarms(number)]
        first = 0
        for index, tray in enumerate(self.trays):
            fans = slice(first, first + tray.fans)
            first += tray.fans
            if tray.name not in self.silent:
                found += self._scores(number, index, tray, fans)
        return [message for _, message in sorted(found, key=lambda pair: pair[0])]

    def _scores(self, second: int, index: int, tray: TrayConfig, fans: slice) -> Iterator[tuple[float, Envelope]]:
        t_s = second + np.arange(round(self.rate_hz)) / self.rate_hz
        noise = self._noise[(index + second) % NOISES, :, : tray.fans]
        predicted = self._speed[fans] + 20.0 * np.sin(0.3 * t_s[:, None] + index).astype(np.float32)
        measured = predicted + noise
        state = np.full(measured.shape, FanState.NORMAL, np.uint8)
        score = np.broadcast_to(self._level[fans], measured.shape) + np.abs(noise) * 0.01
        invalid_reason = np.zeros(measured.shape, np.uint8)
        for excursion in self.excursions:
            if excursion.fan.tray == tray.name:
                _leave_the_band(excursion, t_s, measured, state, score)
        if tray.name in self.gaps:
            state[:], invalid_reason[:] = FanState.UNKNOWN, 2
        valid = state != FanState.UNKNOWN
        values = {
            "command": np.full(measured.shape, 0.5),
            "measured_speed_rad_s": measured,
            "predicted_speed_rad_s": predicted,
            "band_variance": np.full(measured.shape, (2 * SIGMA_RAD_S) ** 2),
            "state": state,
            "valid": valid,
            "invalid_reason": invalid_reason,
            "torque_balance_command": noise / 100,
            "expected_residual_rad_s": np.zeros(measured.shape),
            "expected_balance_command": np.zeros(measured.shape),
            "score": np.where(valid, score, np.nan),
            "statistic": np.where(valid, Statistic.DEVIATION, 0),
        }
        arrays = {name: np.asarray(column, columns(Score)[name].dtype) for name, column in values.items()}
        t_ns = START_NS + np.round(t_s * NS_PER_S).astype(np.int64)
        producer, key = "scorer-all-0123abcd", tray_key(SITE, tray.name, "score")
        for place, start in enumerate(range(0, len(t_s), self._length)):
            rows = slice(start, start + self._length)
            sequence = second * round(1 / self.block_s) + place
            position = InputPosition("prediction", "twin_integrator-all-0123abcd", sequence, sequence + 1, 0)
            message = Score(
                header=Header(producer, sequence, tray.name, position),
                fans=tray.fans,
                period_ns=round(NS_PER_S / self.rate_hz),
                t_ns=t_ns[rows],
                **{name: array[rows] for name, array in arrays.items()},
            )
            envelope = Envelope.of(key, message, int(t_ns[rows][-1]))
            yield t_s[rows][-1], Envelope(key, "score", envelope.payload, envelope.received_t_ns)

    def _alarms(self, second: int) -> Iterator[tuple[float, Alarm]]:
        for excursion in self.excursions:
            raised_s = excursion.onset_s + DELAY_S
            for at_s, active in ((raised_s, True), (raised_s + ALARM_S, False)):
                if second <= at_s < second + 1:
                    yield at_s, _alarm(excursion, at_s, active)


def _leave_the_band(excursion: Excursion, t_s: Array, measured: Array, state: Array, score: Array) -> None:
    fan, since_s = excursion.fan.number, t_s - excursion.onset_s
    ends_s = DELAY_S + ALARM_S
    measured[(since_s >= 0) & (since_s < ends_s - DELAY_S), fan] -= 8 * SIGMA_RAD_S
    score[(since_s >= 0) & (since_s < ends_s), fan] = 2.5 + excursion.fan.number / 100
    for from_s, to_s, what in (
        (0.0, DELAY_S, FanState.SUSPECT),
        (DELAY_S, ends_s - DELAY_S, FanState.ALARM),
        (ends_s - DELAY_S, ends_s, FanState.RETURNING),
    ):
        state[(since_s >= from_s) & (since_s < to_s), fan] = what


def _alarm(excursion: Excursion, at_s: float, active: bool) -> Alarm:
    number = excursion.fan.number
    return Alarm(
        header=Header("scorer-all-0123abcd", round(at_s * 1000), excursion.fan.tray),  # rises with time
        fan=number,
        active=active,
        severity=Severity.ALARM,
        t_ns=START_NS + round(at_s * NS_PER_S),
        onset_t_ns=START_NS + round(excursion.onset_s * NS_PER_S),
        residual_rad_s=-8 * SIGMA_RAD_S if active else 0.0,
        residual_std_rad_s=2 * SIGMA_RAD_S,
        message=f"fan {number}: slower than its twin" if active else f"fan {number}: back in the band",
        transition=Transition.RAISED if active else Transition.CLEARED,
        statistic=Statistic.DEVIATION,
        score=2.5 if active else 0.2,
    )
