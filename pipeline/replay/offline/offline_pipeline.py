"""The stages from raw samples to alarms, run without a bus: raw samples of one tray in, scores and alarms out.

The cores are those of the running stages, built from the same declarations and connected by the topics that these read
and write. They run as fast as possible, on larger blocks; their output does not depend on the block size.
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import chain
from operator import itemgetter
from typing import Any, Literal

import numpy as np

from fantwin.pipeline.replay.offline.plan import BEGINNING, RAW_MISSING, Limit, Session, TrayPlan, limit_through
from fantwin.pipeline.replay.offline.raw_blocks import RawBlocks, SampleStream
from fantwin.pipeline.replay.stage_chain import StageChain
from fantwin.pipeline.runtime.stage import Context, Core, Stage
from fantwin.schemas.blocks import cut
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Message, ModelCard, NewTwin, Prediction, Request, ScorerSnapshot
from fantwin.schemas.messages import newest_t_ns as message_t_ns
from fantwin.schemas.topics import BY_NAME


class OfflinePipeline:
    """One tray's stages, replayed session by session as a plan says."""

    def __init__(
        self,
        stages: StageChain,
        contexts: Iterable[Context],
        raw: RawBlocks,
        plan: TrayPlan,
        observe: Callable[[Message], None],
    ) -> None:
        """contexts: of this tray, one for each stage. observe: is given what each stage makes and a later one consumes,
        the requests, and what the last stage makes."""
        self._contexts = {stage.name: context for stage, context in zip(stages.stages, contexts, strict=True)}
        self._raw = raw
        self._plan = plan
        self._observe = observe
        self.counts: Counter[str] = Counter()
        """counters of all cores, of all sessions"""
        self._limited: set[str] = set()
        """sessions of the first stage that consumed raw messages which the recording lacks"""
        self._last = stages.stages[-1]
        streams: dict[str, SampleStream[Any]] = {}
        for stage, output in zip(stages.stages[:-1], stages.outputs, strict=False):
            streams = {
                session.producer: SampleStream(self._run_stage(stage, output, session, streams))
                for session in plan.sessions[stage.name]
            }
        self._last_inputs = streams

    @property
    def raw_missing(self) -> int:
        """Raw messages that the recording lacks, up to where the pipeline has run."""
        return self._raw.missing

    @property
    def longest_repeat(self) -> float:
        """At most so many samples can a restarted stage consume again."""
        return 2 * BY_NAME["raw"].history * self._raw.samples_in_message

    def limit_of(self, producer: str) -> Limit | None:
        """Up to where the outputs of a session of a stage can be reproduced; exact for what has been run."""
        limits: dict[str, Limit | None] = {}
        for sessions in self._plan.sessions.values():
            limits |= {session.producer: limit_through(session, limits) for session in sessions}
        return limits.get(producer)

    def run(self) -> Iterator[tuple[str, Message]]:
        """What the last stage makes, in order, with the recorded session (its producer) that it belongs to.

        Raises:
            StageError: a stage cannot be built as configured.
            CodecError: a raw message cannot be decoded.
        """
        replayed_snapshot: ScorerSnapshot | None = None
        for session in self._plan.last:
            core: Any = self._core(self._last)
            snapshot = session.snapshot
            if snapshot and not self._plan.uses_recorded_snapshots:
                snapshot = replayed_snapshot
            restored = core.restore(snapshot) if snapshot else ()
            for message in chain(restored, self._run_last(core, session)):
                self._observe(message)
                yield session.producer, message
            replayed_snapshot = None
            for message in self._close(core):
                if isinstance(message, ScorerSnapshot):
                    replayed_snapshot = message
                else:
                    self._observe(message)
                    yield session.producer, message

    def predictions(self) -> Iterator[Prediction]:
        """The input that the last stage, the scorer, would receive; it does not run.

        Raises:
            StageError, CodecError: see `run`.
        """
        for session in self._plan.last:
            yield from self._samples(session, self._last_inputs)

    def _run_stage(
        self, stage: Stage, output: str, session: Session, inputs: Mapping[str, SampleStream[Any]]
    ) -> Iterator[Any]:
        """The blocks of a stage's main output in one session. inputs: by producer; none for the first stage."""
        core: Any = self._core(stage)
        kind = BY_NAME[output].message
        newest_t_ns = BEGINNING
        counters: Mapping[str, int] | None = None
        """what it counted up to the newest message that it certainly consumed"""

        def main_output(messages: Iterable[Message]) -> Iterator[Message]:
            nonlocal newest_t_ns
            for message in messages:
                if isinstance(message, kind):
                    newest_t_ns = max(newest_t_ns, message_t_ns(message))
                    yield message
                else:
                    self._observe(message)

        if inputs:
            for part in self._with_twins(session, inputs):
                yield from main_output(core.step(part))
        else:
            for block, until_t_ns in self._raw.of(session):
                if counters is None and session.producer in self._raw.is_past_known:
                    counters = dict(core.counters())
                if self._begins_to_lack(session):
                    self._limit_by_gap(session, newest_t_ns)
                yield from main_output(core.step(block))
                if until_t_ns is not None:
                    yield from main_output(core.publish_until(until_t_ns))
            if self._begins_to_lack(session):
                self._limit_by_gap(session, newest_t_ns)
        is_last = session is self._plan.first[-1]  # another one consumes what this one is given beyond that
        yield from main_output(self._close(core, None if is_last else counters))

    def _begins_to_lack(self, session: Session) -> bool:
        """Whether the recording lacks raw messages that this session of the first stage consumed next."""
        return session.producer in self._raw.has_gap and session.producer not in self._limited

    def _limit_by_gap(self, session: Session, newest_t_ns: int) -> None:
        self._limited.add(session.producer)
        session.set_limit(newest_t_ns, f"the recording lacks {RAW_MISSING} raw messages that were scored")

    def _run_last(self, core: Any, session: Session) -> Iterator[Message]:
        """What the last stage makes of its samples, and of the requests between them; and its snapshots at the samples
        of the recorded ones."""
        for card in session.twins:
            core.step(card)
        snapshots = ((t_ns, None) for t_ns in dict.fromkeys(session.snapshots_t_ns))
        events = deque(heapq.merge(snapshots, session.requests, key=itemgetter(0)))  # at one time snapshots first
        for part in _interrupted(self._samples(session, self._last_inputs), events, "right"):
            if part is None or isinstance(part, Request):
                yield from self._between_samples(core, part)
            else:
                yield from core.step(part)
        for _, request in events:
            yield from self._between_samples(core, request)

    def _between_samples(self, core: Any, request: Request | None) -> Iterator[Message]:
        """What the last stage makes of a request, or without one its snapshot."""
        if request is None:
            yield from core.last_snapshot()
        else:
            self._observe(request)
            yield from core.step(request)

    def _samples(self, session: Session, streams: Mapping[str, SampleStream[Any]]) -> Iterator[Any]:
        for span in session.spans:
            for block in streams[span.producer].of(span):
                of_session = replace(block, header=Header(span.producer, 0, block.header.tray))
                self._observe(of_session)
                yield of_session

    def _with_twins(self, session: Session, inputs: Mapping[str, SampleStream[Any]]) -> Iterator[Any]:
        """The samples of a session, and before its first sample each learned twin."""
        cards = deque((card.t_ns, card) for card in session.twins)
        for part in _interrupted(self._samples(session, inputs), cards, "left"):
            if isinstance(part, ModelCard):
                yield NewTwin(t_ns=part.t_ns, twin=part.twin, sha256=part.sha256, content=part.content)
            else:
                yield part

    def _core(self, stage: Stage) -> Core:
        return stage.build(self._contexts[stage.name]).core

    def _close(self, core: Core, counters: Mapping[str, int] | None = None) -> list[Message]:
        """Close a core and add its counters, or those given instead."""
        closing = list(core.close())
        self.counts.update(core.counters() if counters is None else counters)
        return closing


def _interrupted(
    blocks: Iterable[Any], events: deque[tuple[int, Any]], side: Literal["left", "right"]
) -> Iterator[Any]:
    """Blocks of samples, cut where an event is due, and the events. What is due after the last sample is left.

    events: in order, each with its time; it comes before a sample of that time (left), or after it (right).
    """
    for block in blocks:
        done = 0
        while events and events[0][0] <= block.t_ns[-1]:
            t_ns, event = events.popleft()
            row = max(done, int(np.searchsorted(block.t_ns, t_ns, side=side)))
            if row > done:
                yield cut(block, done, row)
                done = row
            yield event
        if done < len(block.t_ns):
            yield cut(block, done, len(block.t_ns)) if done else block
