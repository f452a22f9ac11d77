"""What fantwin decides on recordings, as columns: the replay without a bus, and nothing of its own."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.interface.columns import Fan
from fantwin.interface.tables import Array, Form
from fantwin.interface.words import Words
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.replay.offline.alarm_episodes import episodes
from fantwin.pipeline.replay.offline.replay_input import ReplayInput, open_replay_input
from fantwin.pipeline.replay.offline.rescoring import RescoredTray, rescore
from fantwin.schemas.blocks import cut
from fantwin.schemas.enums import FanState, InvalidReason
from fantwin.schemas.messages import Alarm, Message, Prediction, Score
from fantwin.scoring.samples import NOT_ARRIVED, among, reading_missing_of
from fantwin.scoring.score_message import BAND_SIGMAS, ScoreColumns, score_of

LIMIT = 1.0
"""score at which an alarm is raised: scores are relative to their limit"""
_NEVER_NS = np.iinfo(np.int64).min


@dataclass(frozen=True)
class DecidedTray:
    """The scores and alarms of a tray.

    why: (samples, fans) of InvalidReason, why a measured speed cannot be compared with its prediction. A fan may have a
    score nevertheless: by its torque balance, or because it stands. speed_unit, fan_names: of the recording.
    left_out: what could not be used, for people.
    """

    name: str
    fans: int
    scores: tuple[Score, ...]
    why: Array
    alarms: tuple[Alarm, ...]
    speed_unit: str
    fan_names: tuple[str, ...]
    left_out: tuple[str, ...]

    def columns_of_samples(self, fans: Sequence[Fan], form: Form, *, decisions: bool) -> dict[str, Array]:
        """A row for each sample of a fan, (samples * fans,) each: all fans of a time, then the next time.

        decisions: with the columns of scores and alarms, not of the prediction alone.
        """

        def of(value: Callable[[Score], Array]) -> Array:
            return np.concatenate([value(score) for score in self.scores]) if self.scores else np.zeros((0, len(fans)))

        t_ns = of(lambda score: score.t_ns).astype(np.int64).reshape(-1)
        predicted, band = of(lambda score: score.predicted_speed_rad_s), np.sqrt(of(lambda score: score.band_variance))
        is_missing = self.why == InvalidReason.NO_SPEED  # between two readings, the grid has one in the middle
        speeds = {
            "speed": of(lambda score: score.measured_speed_rad_s),
            "predicted": predicted,
            "sigma": band / BAND_SIGMAS,
            "lower": predicted - band,
            "upper": predicted + band,
            "residual": of(lambda score: score.residual_rad_s),
        } | ({"deviation": of(lambda score: score.deviation_rad_s)} if decisions else {})
        for name in speeds.keys() & {"speed", "residual", "deviation"}:
            speeds[name] = np.where(is_missing, np.nan, speeds[name])
        is_known = np.isfinite(speeds["residual"])
        reason = np.where((self.why == InvalidReason.NONE) & ~is_known, InvalidReason.WARMING_UP, self.why)
        columns = {
            "time": np.repeat(form.times(t_ns), len(fans)),
            "fan": np.tile(labels(fans), len(t_ns)),
            "command": of(lambda score: score.command).astype(np.float64),
            **{form.speed_column(name): form.in_unit(speed) for name, speed in speeds.items()},
            "valid": reason == InvalidReason.NONE,
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
        causes[:] = [
            [{"cause": cause.cause, "probability": cause.probability} for cause in each.causes] for each in found
        ]
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


class _Newest:
    """The blocks of a tray, without the samples that a restarted stage repeats."""

    def __init__(self) -> None:
        self._t_ns = _NEVER_NS
        self.blocks: list[Any] = []

    def add(self, block: Prediction | Score) -> None:
        new = block.t_ns > self._t_ns
        if new.any():
            self.blocks.append(block if new.all() else cut(block, int(np.argmax(new)), len(new)))
            self._t_ns = max(int(block.t_ns[-1]), self._t_ns)


def decided(recording: Path, twin: Path, overrides: Sequence[str], words: Words, *, scores: bool) -> list[DecidedTray]:
    """The decisions on a recording with this twin. scores: not only its prediction, which takes a tenth of the time.

    Raises:
        FantwinError: the recording or the twin cannot be used.

    Warns:
        FantwinWarning: a file is damaged.
    """
    found: dict[tuple[str, type[Message]], _Newest] = defaultdict(_Newest)

    def observe(tray: str, message: Message) -> None:
        if isinstance(message, Score | Prediction) and len(message.t_ns):
            found[tray, type(message)].add(message)

    with open_replay_input([recording], None, tuple(overrides), twin) as replay_input:
        if scores:
            trays = rescore(replay_input, None, verify=False, observe=observe)
        else:
            trays = [_predicted(replay_input, tray, twin, observe) for tray in replay_input.trays]
        fans = {tray.name: tray.fans for tray in replay_input.trays}
        metadata = replay_input.metadata
        words.warn(replay_input.damage.values())
    return [
        DecidedTray(
            name=each.tray,
            fans=fans[each.tray],
            scores=tuple(blocks := found[each.tray, Score].blocks),
            why=_why(found[each.tray, Prediction].blocks, blocks, fans[each.tray]),
            alarms=tuple(each.alarms),
            speed_unit=metadata.speed_unit(each.tray),
            fan_names=metadata.names(each.tray).names,
            left_out=tuple(_left_out(each)),
        )
        for each in trays
    ]


def _predicted(
    replay_input: ReplayInput, tray: TrayConfig, path: Path, observe: Callable[[str, Message], None]
) -> RescoredTray:
    """What a scorer would receive, as its message without evidence. path: of the twin."""
    twin, plan = load_tray_twin(path, tray.fans), replay_input.read_plan(tray.name).plan
    found = RescoredTray(tray.name, plan, names=replay_input.metadata.names(tray.name))
    pipeline = replay_input.pipeline(tray.name, plan)
    reads_balance, unseen_error = np.zeros(tray.fans, np.bool_), twin.unseen_error
    for item in pipeline.predictions():
        unseen_rad_s = np.nan_to_num(unseen_error.of(item)[0]) if unseen_error else 0.0
        score = score_of(item, ScoreColumns.empty(*item.valid.shape), reads_balance, unseen_rad_s)
        found.add(score, pipeline.longest_repeat)
        observe(tray.name, item)
        observe(tray.name, score)
    found.counts, found.raw_missing = pipeline.counts, pipeline.raw_missing
    return found


def _why(predictions: Sequence[Prediction], scores: Sequence[Score], fans: int) -> Array:
    """(samples, fans) why samples cannot be compared with their prediction, by it, at the times of the scores."""
    if not scores:
        return np.zeros((0, fans), np.uint8)
    t_ns, reason, missing = (
        np.concatenate([value(item) for item in predictions])
        for value in (lambda item: item.t_ns, lambda item: item.invalid_reason, reading_missing_of)
    )
    rows = np.searchsorted(t_ns, np.concatenate([score.t_ns for score in scores]))
    silent = among(reason, *NOT_ARRIVED)
    return np.where(missing & ~silent, np.uint8(InvalidReason.NO_SPEED), reason)[rows]


def _left_out(tray: RescoredTray) -> list[str]:
    lost = [f"{tray.tray}: {tray.lost} messages or samples are lost"] if tray.lost else []
    return [*lost, *filter(None, (tray.problem, tray.misfit))]
