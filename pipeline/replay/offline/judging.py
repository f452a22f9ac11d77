"""Judging a recording again, without a bus: the same stage cores, in event-time order, in one process."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pipeline.errors import UserError
from pipeline.recordings.metadata import recording_metadata
from pipeline.recordings.writing import ACTIVE_SUFFIX, RecordingWriter
from pipeline.replay.offline.offline_pipeline import OfflinePipeline, ReplayedMessage
from pipeline.replay.offline.plan import TrayPlan, undisturbed
from pipeline.replay.offline.replay_input import ReplayInput
from pipeline.replay.offline.verify import (
    Comparison,
    RecordedSession,
    compare_alarms,
    compare_scores,
    note_not_made,
)
from schemas.blocks import cut
from schemas.codec import CodecError
from schemas.messages import Alarm, Grid, Header, Message, Prediction, Raw, Request, Score, newest_t_ns
from schemas.streams import LOSS_PREFIX
from schemas.topics import TOPICS, tray_key

Progress = Callable[[str, int], None]
"""Is told the tray, and the time of the newest sample that was judged, ns since the epoch."""
_ROWS_WRITTEN = 100
"""samples a message: who plays the file goes from one to the next, and a torn file loses few"""
_TOPIC_NAMES = {topic.message: topic.name for topic in TOPICS}


class CannotCompareError(UserError):
    """What was made anew cannot be held against the recording."""


@dataclass
class JudgedTray:
    """What came of one tray."""

    tray: str
    plan: TrayPlan
    samples: int = 0
    judged: int = 0
    """samples of the tray that could be judged, for one fan at least"""
    not_judged: Counter[str] = field(default_factory=Counter)
    """why samples of fans could not"""
    period_ns: int = 0
    start_ns: int = 0
    end_ns: int = 0
    """times of the first and the last sample that was scored"""
    alarms: list[Alarm] = field(default_factory=list)
    recorded_alarms: list[Alarm] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    raw_missing: int = 0
    comparison: Comparison | None = None

    @property
    def hours(self) -> float:
        """How long the tray was judged."""
        return self.judged * self.period_ns / 3.6e12

    @property
    def problem(self) -> str:
        """Why nothing was judged, if so."""
        if self.judged:
            return ""
        if not self.not_judged:
            return f"{self.tray}: no sample lies between --start and --end"
        reasons = ", ".join(f"{count} {why.replace('_', ' ')}" for why, count in self.not_judged.most_common(3))
        return f"{self.tray}: no sample could be judged (of fans: {reasons}): does the twin fit this recording?"

    @property
    def lost(self) -> int:
        """What the recording lacks and what the stages could not use."""
        return self.raw_missing + sum(n for name, n in self.counts.items() if name.startswith(LOSS_PREFIX))


def judge(
    material: ReplayInput, output: Path | None, verify: bool, progress: Progress = lambda _tray, _t_ns: None
) -> list[JudgedTray]:
    """Judge every tray again.

    output: a recording to write, with the raw samples and all that was made of them. verify: hold scores and alarms
    against those recorded.

    Raises:
        CannotCompareError: they cannot be compared: the recording has none, or lacks what they were made of.
        StageError: a stage cannot be built as configured.
        RecordingError: the output cannot be written.
        UserError: the output exists.
    """
    if output is None:
        return [_judge_tray(material, tray.name, verify, None, progress) for tray in material.trays]
    with _writer(material, output) as writer:
        return [_judge_tray(material, tray.name, verify, writer, progress) for tray in material.trays]


def _judge_tray(
    material: ReplayInput, tray: str, verify: bool, writer: RecordingWriter | None, progress: Progress
) -> JudgedTray:
    plan, recorded_alarms = material.survey(tray)
    if verify:
        _refuse_what_cannot_be_verified(material, tray, plan)
    judged = JudgedTray(tray, plan or undisturbed(), recorded_alarms=recorded_alarms)
    config = material.config.tray(tray)
    outputs = _Outputs(writer, material.config.site, tray) if writer else None
    chain = OfflinePipeline(
        material.contexts(config),
        lambda: material.raw(tray),
        judged.plan,
        outputs.write if outputs else lambda _message: None,
        (material.from_s, material.to_s),
    )
    comparing = _Comparing(material, judged) if verify else None
    try:
        for made in chain.run():
            if isinstance(made.message, Alarm):
                judged.alarms.append(replace(made.message, header=Header(made.producer, 0, tray)))
            elif isinstance(made.message, Score):
                judged.period_ns = made.message.period_ns
                judged.start_ns = judged.start_ns or int(made.message.t_ns[0])
                judged.end_ns = int(made.message.t_ns[-1])
                progress(tray, int(made.message.t_ns[-1]))
            if comparing:
                comparing.take(made)
    except CodecError as error:
        raise UserError(f"{material.paths[0]}: a message cannot be decoded: {error}; see `fantwin info`") from error
    judged.samples, judged.judged, judged.not_judged = chain.samples, chain.judged, chain.not_judged
    judged.counts, judged.raw_missing = chain.counts, chain.raw_missing
    if comparing:
        judged.comparison = comparing.end()
        _refuse_what_could_not_be_compared(f"{material.paths[0]}: {tray}", judged)
    return judged


def _refuse_what_could_not_be_compared(where: str, judged: JudgedTray) -> None:
    found = judged.comparison
    assert found
    if not (found.equal or found.different or found.not_made):
        raise CannotCompareError(f"{where}: no scores in the recording: nothing to compare with")
    if found.is_equal:
        return
    if judged.raw_missing:
        raise CannotCompareError(f"{where}: the recording lacks {judged.raw_missing} raw messages that were judged")
    if any(session.is_guessed for session in judged.plan.resampler):
        raise CannotCompareError(
            f"{where}: some raw messages never came to the resampler, and which is not known: it is not made the same"
        )


def _refuse_what_cannot_be_verified(material: ReplayInput, tray: str, plan: TrayPlan | None) -> None:
    where = f"{material.paths[0]}: {tray}"
    if material.is_part:
        raise CannotCompareError(f"{where}: a part of a run cannot be compared: leave out --start and --end")
    if plan is None:
        raise CannotCompareError(f"{where}: no scores that say what they were made of: nothing to compare with")
    if plan.began_before:
        raise CannotCompareError(
            f"{where}: the recording begins in the middle of {', '.join(sorted(plan.began_before))}: "
            "name the parts before it as well"
        )


class _Comparing:
    """Holds what the chain makes against the recording, session by session."""

    def __init__(self, material: ReplayInput, judged: JudgedTray) -> None:
        self._material = material
        self._judged = judged
        self._producer: str | None = None
        self._visited: set[str] = set()
        self._recorded: RecordedSession | None = None
        self._found = Comparison(judged.tray)

    def take(self, made: ReplayedMessage) -> None:
        if made.producer != self._producer:
            self._end_session()
            self._begin_session(made.producer)
        if isinstance(made.message, Score):
            assert self._recorded
            compare_scores(made.message, self._recorded, self._found)

    def end(self) -> Comparison:
        self._end_session()
        for session in self._judged.plan.scorer:
            producer = session.producer
            if producer not in self._visited:
                self._begin_session(producer)
                self._end_session()
            compare_alarms(
                [alarm for alarm in self._judged.alarms if alarm.header.producer == producer],
                [alarm for alarm in self._judged.recorded_alarms if alarm.header.producer == producer],
                self._judged.plan.last_scored_t_ns[producer],
                self._found,
            )
        return self._found

    def _begin_session(self, producer: str) -> None:
        self._producer = producer
        self._visited.add(producer)
        self._recorded = RecordedSession(self._material.packets(self._judged.tray, ("score",)), producer)

    def _end_session(self) -> None:
        if self._recorded:
            for block in self._recorded.until(None):
                note_not_made(block.t_ns, self._found)
        self._recorded = None


def _writer(material: ReplayInput, output: Path) -> RecordingWriter:
    for there in (output, output.with_name(output.name + ACTIVE_SUFFIX)):
        if there.exists():
            raise UserError(f"{there}: exists already; name another file with -o, or remove it")
    contexts = [material.contexts(tray)["scorer"] for tray in material.trays]
    metadata, attachments = recording_metadata(replace(contexts[0], trays=tuple(context.tray for context in contexts)))
    metadata["source"] = ",".join(path.name for path in material.paths)
    return RecordingWriter(output, metadata, attachments)


class _Outputs:
    """Writes what is made, and the raw samples beside it, each sample once."""

    def __init__(self, writer: RecordingWriter, site: str, tray: str) -> None:
        self._writer = writer
        self._site = site
        self._tray = tray
        self._sequences: Counter[str] = Counter()
        self._asked: set[Header] = set()
        self._written_t_ns: dict[type[Message], int] = defaultdict(lambda: np.iinfo(np.int64).min)

    def write(self, message: Message) -> None:
        if isinstance(message, Grid | Prediction | Score):  # a session that begins anew gives some of them again
            first = int(np.searchsorted(message.t_ns, self._written_t_ns[type(message)], side="right"))
            if first == len(message.t_ns):
                return
            message = cut(message, first, len(message.t_ns))
            self._written_t_ns[type(message)] = int(message.t_ns[-1])
        if isinstance(message, Raw | Grid | Prediction | Score):
            for first in range(0, len(message.command), _ROWS_WRITTEN):
                self._write(cut(message, first, min(first + _ROWS_WRITTEN, len(message.command))))
        else:
            self._write(message)

    def _write(self, message: Message) -> None:
        topic = _TOPIC_NAMES[type(message)]
        header = Header(f"offline-{topic}", self._sequences[topic], self._tray)
        if isinstance(message, Request):  # answers name it
            header = message.header
            if header in self._asked:
                return
            self._asked.add(header)
        self._sequences[topic] += 1
        key = tray_key(self._site, self._tray, topic)
        self._writer.add_message(key, replace(message, header=header), newest_t_ns(message))
