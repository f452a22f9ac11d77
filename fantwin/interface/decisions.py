"""What fantwin decides on recordings, as columns: the replay without a bus, and nothing of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fantwin.interface.columns import Fan
from fantwin.interface.tables import Array, Form
from fantwin.interface.words import warn
from fantwin.pipeline.replay.offline.alarm_episodes import episodes
from fantwin.pipeline.replay.offline.replay_input import open_replay_input
from fantwin.pipeline.replay.offline.rescoring import RescoredTray, rescore
from fantwin.schemas.blocks import cut
from fantwin.schemas.enums import FanState, InvalidReason
from fantwin.schemas.messages import Alarm, Message, Score
from fantwin.scoring.score_message import BAND_SIGMAS

LIMIT = 1.0
"""score at which an alarm is raised: scores are relative to their limit"""
_NEVER_NS = np.iinfo(np.int64).min


@dataclass(frozen=True)
class DecidedTray:
    """The scores and alarms of a tray. speed_unit: of the recording."""

    name: str
    fans: int
    scores: tuple[Score, ...]
    alarms: tuple[Alarm, ...]
    speed_unit: str

    def columns_of_samples(self, fans: Sequence[Fan], form: Form, *, decisions: bool) -> dict[str, Array]:
        """A row for each sample of a fan, (samples * fans,) each: all fans of a time, then the next time.

        decisions: with the columns of scores and alarms, not of the prediction alone.
        """

        def of(value: Callable[[Score], Array]) -> Array:
            return np.concatenate([value(score) for score in self.scores]) if self.scores else np.zeros((0, len(fans)))

        t_ns = of(lambda score: score.t_ns).astype(np.int64).reshape(-1)
        predicted, band = of(lambda score: score.predicted_speed_rad_s), np.sqrt(of(lambda score: score.band_variance))
        speeds = {
            "speed": of(lambda score: score.measured_speed_rad_s),
            "predicted": predicted,
            "sigma": band / BAND_SIGMAS,
            "lower": predicted - band,
            "upper": predicted + band,
            "residual": of(lambda score: score.residual_rad_s),
            "deviation": of(lambda score: score.deviation_rad_s),
        }
        reason = of(lambda score: score.invalid_reason)
        columns = {
            "time": np.repeat(form.times(t_ns), len(fans)),
            "fan": np.tile(labels(fans), len(t_ns)),
            "command": of(lambda score: score.command).astype(np.float64),
            **{form.speed_column(name): form.in_unit(speed) for name, speed in speeds.items()},
            "valid": of(lambda score: score.valid).astype(np.bool_),
            "reason": _words(reason, InvalidReason, {InvalidReason.NONE: ""}),
        }
        if decisions:
            state = of(lambda score: score.state)
            columns |= {
                "score": of(lambda score: score.score).astype(np.float64),
                "limit": np.full(predicted.shape, LIMIT),
                "state": _words(state, FanState, {}),
                **self._alarm_columns(t_ns, len(fans)),
            }
        return {name: values.reshape(-1) for name, values in columns.items()}

    def _alarm_columns(self, t_ns: Array, fans: int) -> dict[str, Array]:
        """Whether a fan has an alarm at each sample, (samples, fans), its severity, and its most probable cause."""
        alarm = np.zeros((len(t_ns), fans), np.bool_)
        severity, cause = np.full(alarm.shape, "", np.object_), np.full(alarm.shape, "", np.object_)
        probability = np.full(alarm.shape, np.nan)
        for message in sorted(self.alarms, key=lambda each: each.t_ns):
            rows, fan = slice(int(np.searchsorted(t_ns, message.t_ns)), None), message.fan
            first = message.causes[0] if message.active and message.causes else None
            alarm[rows, fan] = message.active
            severity[rows, fan] = message.severity.name.lower() if message.active else ""
            cause[rows, fan], probability[rows, fan] = (first.cause, first.probability) if first else ("", np.nan)
        return {"alarm": alarm, "severity": severity, "cause": cause, "probability": probability}

    def columns_of_alarms(self, fans: Sequence[Fan], form: Form) -> dict[str, Array]:
        """A row for each alarm, in the order they were raised."""
        found = episodes(self.alarms)
        cleared_ns = [_NEVER_NS if each.cleared_ns is None else each.cleared_ns for each in found]
        causes = np.empty(len(found), np.object_)
        causes[:] = [{cause.cause: cause.probability for cause in each.causes} for each in found]
        return {
            "fan": labels([fans[each.fan] for each in found]) if found else labels(fans)[:0],
            "raised": form.times(np.array([each.raised_ns for each in found], np.int64)),
            "cleared": form.times(np.array(cleared_ns, np.int64)),
            "onset": form.times(np.array([each.onset_ns for each in found], np.int64)),
            "severity": np.array([each.severity for each in found], np.object_),
            "cause": np.array([each.causes[0].cause if each.causes else "" for each in found], np.object_),
            "probability": np.array([each.causes[0].probability if each.causes else np.nan for each in found]),
            "causes": causes,
        }


def labels(fans: Sequence[Fan]) -> Array:
    """(fans,) numbers, or the numbers and names, of fans."""
    return np.array(fans, np.int64 if all(isinstance(fan, int) for fan in fans) else np.object_)


def _words(values: Array, enum: type[InvalidReason] | type[FanState], others: Mapping[int, str]) -> Array:
    words = {int(value): enum(int(value)).name.lower() for value in np.unique(values)} | dict(others)
    known = np.array([words.get(value, "") for value in range(256)], np.object_)
    return known[values.astype(np.int64)]


def decided(recording: Path, twin: Path, overrides: Sequence[str] = ()) -> list[DecidedTray]:
    """The decisions on a recording with this twin; warns of what could not be used.

    Raises:
        FantwinError: the recording or the twin cannot be used.
    """
    scores: dict[str, list[Score]] = {}
    newest_ns: dict[str, int] = {}

    def observe(tray: str, message: Message) -> None:
        if isinstance(message, Score) and len(message.t_ns):
            new = message.t_ns > newest_ns.get(tray, _NEVER_NS)
            if new.all():
                scores.setdefault(tray, []).append(message)
            elif new.any():
                first = int(np.argmax(new))
                scores.setdefault(tray, []).append(cut(message, first, len(new)))
            newest_ns[tray] = max(int(message.t_ns[-1]), newest_ns.get(tray, _NEVER_NS))

    with open_replay_input([recording], None, tuple(overrides), twin) as replay_input:
        trays = rescore(replay_input, None, verify=False, observe=observe)
        fans = {tray.name: tray.fans for tray in replay_input.trays}
        units = {tray.tray: replay_input.metadata.speed_unit(tray.tray) for tray in trays}
        warn(replay_input.damage.values())
    warn(line for tray in trays for line in _left_out(tray))
    return [
        DecidedTray(each.tray, fans[each.tray], tuple(scores.get(each.tray, ())), tuple(each.alarms), units[each.tray])
        for each in trays
    ]


def _left_out(tray: RescoredTray) -> list[str]:
    lost = [f"{tray.tray}: {tray.lost} messages or samples are lost"] if tray.lost else []
    return [*lost, *([tray.problem] if tray.problem else [])]
