"""Scoring a recording again: the stages of every tray run over its raw samples, in one process and without a bus.

`fantwin replay --offline -o` writes a recording of it: the raw samples used and everything computed from them, each
sample once.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.metadata import recording_metadata
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.replay.offline.comparison import CannotCompareError, Comparison
from fantwin.pipeline.replay.offline.plan import RAW_MISSING, TrayPlan
from fantwin.pipeline.replay.offline.replay_input import ReadPlan, ReplayInput
from fantwin.pipeline.replay.offline.verify import TrayVerifier
from fantwin.schemas.blocks import cut
from fantwin.schemas.codec import CodecError
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.header import Header
from fantwin.schemas.messages import (
    Alarm,
    Array,
    Grid,
    Message,
    Overview,
    Prediction,
    Raw,
    Request,
    Score,
    newest_t_ns,
)
from fantwin.schemas.streams import LOSS_PREFIX
from fantwin.schemas.topics import TOPICS, tray_key
from fantwin.schemas.twin_card import LOOSER
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.score_message import BAND_SIGMAS

MESSAGE_SAMPLES = 100
"""samples a message: few, for a player that steps by messages and for a file that is truncated"""
_TOPIC_OF = {topic.message: topic.name for topic in TOPICS}


def output_writer(replay_input: ReplayInput, output: Path) -> RecordingWriter:
    """The writer of a new recording, with the configuration and the twins that are used.

    Raises:
        RecordingError: it cannot be written.
    """
    contexts = [replay_input.contexts(tray)[-1] for tray in replay_input.trays]
    metadata, attachments = recording_metadata(replace(contexts[0], trays=tuple(context.tray for context in contexts)))
    metadata["source"] = ",".join(path.name for path in replay_input.paths)
    return RecordingWriter(output, metadata, attachments)


class TrayOutput:
    """Writes the messages of one tray."""

    def __init__(self, writer: RecordingWriter, site: str, tray: str) -> None:
        self._writer = writer
        self._site = site
        self._tray = tray
        self._sequences: Counter[str] = Counter()
        self._requests: set[Header] = set()
        self._newest_t_ns: dict[type[Message], int] = defaultdict(lambda: np.iinfo(np.int64).min)

    def add(self, message: Message) -> None:
        """Write a message, without the samples that an earlier session has made already."""
        if isinstance(message, Grid | Prediction | Score | Overview):
            first = int(np.searchsorted(message.t_ns, self._newest_t_ns[type(message)], side="right"))
            if first == len(message.t_ns):
                return
            message = cut(message, first, len(message.t_ns))
            self._newest_t_ns[type(message)] = int(message.t_ns[-1])
        if isinstance(message, Raw | Grid | Prediction | Score):
            samples = len(message.command)
            for first in range(0, samples, MESSAGE_SAMPLES):
                self._write(cut(message, first, min(first + MESSAGE_SAMPLES, samples)))
        else:
            self._write(message)

    def _write(self, message: Message) -> None:
        topic = _TOPIC_OF[type(message)]
        header = Header(f"offline-{topic}", self._sequences[topic], self._tray)
        if isinstance(message, Request):  # alarms refer to it by its own producer and sequence number
            header = message.header
            if header in self._requests:
                return
            self._requests.add(header)
        self._sequences[topic] += 1
        key = tray_key(self._site, self._tray, topic)
        self._writer.add_message(key, replace(message, header=header), newest_t_ns(message))


Progress = Callable[[str, int], None]
"""Called with the tray, and the time of the newest scored sample in ns since the epoch."""
Observe = Callable[[str, Message], None]
"""Called with the tray, and each message that is read or made; samples that a session repeats come again."""


@dataclass
class RescoredTray:
    """The decisions on one tray."""

    tray: str
    plan: TrayPlan
    samples: int = 0
    """samples of the tray that have a score message, each once"""
    scored: int = 0
    """those that could be scored for at least one fan"""
    judged: int = 0
    """samples of fans that could be scored"""
    not_judged: Counter[str] = field(default_factory=Counter)
    """samples of fans that could not be scored, by reason"""
    errors: Array = field(default_factory=lambda: np.zeros((2, 1)))
    """(2, fans) number of residuals, and sum of their squares relative to the variance of the band"""
    period_ns: int = 0
    start_ns: int = np.iinfo(np.int64).max
    end_ns: int = np.iinfo(np.int64).min
    """times of the first and the last sample with a score message"""
    alarms: list[Alarm] = field(default_factory=list)
    recorded_alarms: list[Alarm] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    """the stages' counters"""
    raw_missing: int = 0
    comparison: Comparison | None = None
    names: FanNames = NO_NAMES
    _newest_t_ns: int = np.iinfo(np.int64).min

    @property
    def hours(self) -> float:
        """How long the tray was scored."""
        return self.scored * self.period_ns / NS_PER_S / 3600

    @property
    def problem(self) -> str:
        """Why nothing was scored; empty if something was."""
        if self.scored:
            return ""
        if not self.not_judged:
            return f"{self.tray}: no sample lies between --from and --to"
        reasons = ", ".join(f"{count} {why.replace('_', ' ')}" for why, count in self.not_judged.most_common(3))
        return f"{self.tray}: no sample could be scored (of fans: {reasons}): does the twin fit this recording?"

    @property
    def misfit(self) -> str:
        """A line on the fans that the twin does not follow; empty where it follows all."""
        rms = np.sqrt(self.errors[1] / np.maximum(self.errors[0], 1.0))
        fans = np.flatnonzero(rms > LOOSER)
        if not len(fans):
            return ""
        which = f"{self.names.labels(fans.tolist())}: rmse {'up to ' if len(fans) > 1 else ''}{rms.max():.2f}"
        return f"{self.tray}: the twin does not follow {which} times its sigma: a fault, or not its twin"

    @property
    def lost(self) -> int:
        """Messages that the recording lacks, and samples that the stages counted as lost."""
        return self.raw_missing + sum(n for name, n in self.counts.items() if name.startswith(LOSS_PREFIX))

    def add(self, score: Score, longest_repeat: float) -> None:
        """Count the samples of a block; those that an earlier session has scored already do not count again.

        longest_repeat: at most so many samples does a restarted stage repeat. Samples from further back are not
        repeated: the clock was set back.
        """
        if int(score.t_ns[0]) < self._newest_t_ns - longest_repeat * score.period_ns:
            self._newest_t_ns = int(score.t_ns[0]) - 1
        self.period_ns = score.period_ns
        first_ns, last_ns = int(score.t_ns[0]), int(score.t_ns[-1])
        self.start_ns = min(self.start_ns, first_ns)
        self.end_ns = max(self.end_ns, last_ns)
        new = score.t_ns > self._newest_t_ns
        self._newest_t_ns = max(self._newest_t_ns, last_ns)
        valid = score.valid[new]
        self.samples += int(new.sum())
        self.scored += int(valid.any(axis=1).sum())
        self.judged += int(valid.sum())
        errors = np.where(valid, score.residual_rad_s[new] ** 2 / (score.band_variance[new] / BAND_SIGMAS**2), np.nan)
        self.errors = self.errors + np.array([np.isfinite(errors).sum(axis=0), np.nansum(errors, axis=0)])
        for reason, count in zip(*np.unique(score.invalid_reason[new][~valid], return_counts=True), strict=True):
            self.not_judged[InvalidReason(reason).name.lower()] += int(count)


def rescore(
    replay_input: ReplayInput,
    output: Path | None,
    verify: bool,
    progress: Progress = lambda _tray, _t_ns: None,
    observe: Observe = lambda _tray, _message: None,
) -> list[RescoredTray]:
    """Score every tray again.

    output: a recording to write, with the raw samples and everything computed from them. verify: compare scores and
    alarms with the recorded ones.

    Raises:
        CannotCompareError: the recording has no scores, or lacks the input from which they were computed.
        StageError: a stage cannot be built as configured.
        RecordingError: the output cannot be written.
    """
    if verify and replay_input.is_part:
        raise CannotCompareError(
            f"{replay_input.paths[0]}: a part of a run cannot be compared: leave out --from and --to"
        )
    plans = {tray.name: replay_input.read_plan(tray.name) for tray in replay_input.trays}
    if verify and all(found.why_not_verified for found in plans.values()):
        raise _cannot_compare(replay_input, [f"{tray}: {found.why_not_verified}" for tray, found in plans.items()])
    with output_writer(replay_input, output) if output else nullcontext() as writer:
        trays = [
            _rescore_tray(replay_input, tray, found, verify, writer, progress, observe) for tray, found in plans.items()
        ]
    compared = [tray.comparison for tray in trays if tray.comparison]
    if verify and not any(found.has_content for found in compared):
        raise _cannot_compare(replay_input, [reason for found in compared for reason in found.reasons])
    return trays


def _cannot_compare(replay_input: ReplayInput, reasons: Iterable[str]) -> CannotCompareError:
    return CannotCompareError(f"{replay_input.paths[0]}: {'; '.join(reasons)}")


def _rescore_tray(
    replay_input: ReplayInput,
    tray: str,
    found: ReadPlan,
    verify: bool,
    writer: RecordingWriter | None,
    progress: Progress,
    observe_all: Observe,
) -> RescoredTray:
    rescored = RescoredTray(tray, found.plan, recorded_alarms=found.alarms, names=replay_input.metadata.names(tray))
    output = TrayOutput(writer, replay_input.config.site, tray) if writer else None
    verifier: TrayVerifier | None = None

    def observe(message: Message) -> None:
        observe_all(tray, message)
        if output:
            output.add(message)
        if verifier and isinstance(message, Grid | Prediction):
            verifier.add(message.header.producer, message)

    pipeline = replay_input.pipeline(tray, found.plan, observe)
    verifier = (
        TrayVerifier(
            tray,
            lambda topic: replay_input.envelopes(tray, (topic,)),
            pipeline.limit_of,
            replay_input.metadata.left_out,
        )
        if verify and not found.why_not_verified
        else None
    )
    try:
        for producer, message in pipeline.run():
            if isinstance(message, Alarm):
                rescored.alarms.append(replace(message, header=Header(producer, 0, tray)))
            elif isinstance(message, Score):
                rescored.add(message, pipeline.longest_repeat)
                progress(tray, rescored.end_ns)
            if verifier:
                verifier.add(producer, message)
    except CodecError as error:
        raise UserError(f"{replay_input.paths[0]}: a message cannot be decoded: {error}; see `fantwin info`") from error
    rescored.counts, rescored.raw_missing = pipeline.counts, pipeline.raw_missing
    if verifier:
        rescored.comparison = compared = verifier.finish(found.plan.last, rescored.alarms, found.alarms)
        compared.reasons = [reason.replace(RAW_MISSING, str(rescored.raw_missing)) for reason in compared.reasons]
        if not (compared.has_content or compared.reasons):
            what = "scores" if compared.has_scores else "alarms or snapshots"
            compared.reasons.append(f"{tray}: no {what} in the recording: nothing to compare with")
    elif verify:
        rescored.comparison = Comparison(tray, reasons=[f"{tray}: {found.why_not_verified}"])
    return rescored
