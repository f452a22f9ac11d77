"""The stages that decide, driven without a bus: raw samples of one tray in, scores and alarms out, as fast as they go.

The cores are those that run beside the fans, built by their own declarations. They are handed larger blocks, and
nothing else is different: what they give does not depend on the size of a block.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Generic, TypeVar

import numpy as np

from pipeline.replay.offline.plan import RawSpan, ResamplerSession, RowSession, RowSpan, TrayPlan
from pipeline.runtime.stage import Context, Core, load_stage
from schemas.blocks import cut
from schemas.envelope import Envelope
from schemas.fast_decode import decode_header, decode_together
from schemas.messages import Grid, InvalidReason, Message, Prediction, Raw, Score, ScorerSnapshot

BLOCK = 512
"""messages and rows that are handed over at once"""
_Rows = TypeVar("_Rows", Grid, Prediction)


@dataclass(frozen=True)
class ReplayedMessage:
    """A message that the chain made, and the session of the recording that it belongs to."""

    producer: str
    message: Message


class _Stream(Generic[_Rows]):
    """The rows of one session, made when they are asked for; those that will be asked for again are kept."""

    def __init__(self, blocks: Iterator[_Rows]) -> None:
        self._blocks = blocks
        self._kept: deque[_Rows] = deque()

    def of(self, span: RowSpan, keep_from_t_ns: int | None) -> Iterator[_Rows]:
        """Blocks of the rows of a span. What is older than keep_from_t_ns will not be wanted again; None: nothing."""
        for block in self._all(keep_from_t_ns):
            first, last = 0, len(block.t_ns)
            if span.first_t_ns is not None:
                first = int(np.searchsorted(block.t_ns, span.first_t_ns, side="left"))
            if span.last_t_ns is not None:
                last = int(np.searchsorted(block.t_ns, span.last_t_ns, side="right"))
            if first < last:
                yield block if (first, last) == (0, len(block.t_ns)) else cut(block, first, last)
            if span.last_t_ns is not None and block.t_ns[-1] >= span.last_t_ns:
                return

    def _all(self, keep_from_t_ns: int | None) -> Iterator[_Rows]:
        had = tuple(self._kept)
        self._kept = deque(block for block in had if self._is_wanted(block, keep_from_t_ns))
        yield from had
        for block in self._blocks:
            if self._is_wanted(block, keep_from_t_ns):
                self._kept.append(block)
            yield block

    @staticmethod
    def _is_wanted(block: _Rows, from_t_ns: int | None) -> bool:
        return from_t_ns is not None and int(block.t_ns[-1]) >= from_t_ns


def _kept_from(sessions: Sequence[RowSession]) -> dict[int, int | None]:
    """For each span, by its id: from which time on later spans want rows of the same producer; None: there are none."""
    wanted: dict[str, int] = {}
    kept: dict[int, int | None] = {}
    for span in reversed([span for session in sessions for span in session.spans]):
        kept[id(span)] = wanted.get(span.producer)
        first = np.iinfo(np.int64).min if span.first_t_ns is None else span.first_t_ns
        wanted[span.producer] = min(first, wanted.get(span.producer, first))
    return kept


class OfflinePipeline:
    """One tray's stages, replayed session by session as a plan says."""

    def __init__(
        self,
        contexts: Mapping[str, Context],
        raw: Callable[[], Iterable[Envelope]],
        plan: TrayPlan,
        observe: Callable[[Message], None],
        stretch_s: tuple[float, float] = (0.0, math.inf),
    ) -> None:
        """Prepare a replay.

        contexts: of each stage of `pipeline.replay.offline.plan.CHAIN`, for this tray. raw: the tray's raw packets in
        the order
        they were recorded, from the beginning at each call. observe: is handed the raw samples, each once, what
        stages have made and others have taken, and what operators asked for. stretch_s: the part of the raw samples
        that is judged, since the first.
        """
        self._contexts = dict(contexts)
        self._raw = raw
        self._plan = plan
        self._observe = observe
        self.counts: Counter[str] = Counter()
        """counters of all cores, of all sessions"""
        self.samples = 0
        """of the tray that were scored, each once"""
        self.judged = 0
        """those among them that could be judged, for one fan at least"""
        self.not_judged: Counter[str] = Counter()
        """why samples of fans could not be judged"""
        self._taken: dict[str, int] = {}
        """of each producer of raw messages: the number that no session has taken yet"""
        self._scored_t_ns = np.iinfo(np.int64).min
        self._holes: dict[tuple[str, int], int] = {}
        self._stretch_s = stretch_s
        self._began_t_ns: int | None = None
        self._kept_from = _kept_from(plan.twin_integrator) | _kept_from(plan.scorer)
        large = contexts["resampler"].config.model_copy(update={"block_size": BLOCK})
        self._contexts["resampler"] = replace(contexts["resampler"], config=large)
        self._grids = {s.producer: _Stream(self._resample(s)) for s in plan.resampler}
        self._predictions = {s.producer: _Stream(self._predict(s)) for s in plan.twin_integrator}

    def run(self) -> Iterator[ReplayedMessage]:
        """What the scorer makes, in order.

        Raises:
            StageError: a stage cannot be built as configured.
            CodecError: a raw packet cannot be decoded.
        """
        own: ScorerSnapshot | None = None
        for session in self._plan.scorer:
            core: Any = self._core("scorer")
            snapshot = self._plan.snapshots.get(session.producer)
            if snapshot and not self._plan.is_as_recorded:
                snapshot = own  # what the one before has found here, which may be something else
            remembered = core.restore(snapshot) if snapshot else ()
            for message in chain(remembered, self._score(core, session)):
                if isinstance(message, Score):
                    self._count(message)
                self._observe(message)
                yield ReplayedMessage(session.producer, message)
            own = next((message for message in self._end(core) if isinstance(message, ScorerSnapshot)), None)

    def predictions(self) -> Iterator[Prediction]:
        """What the scorer would be fed, and no scorer.

        Raises:
            StageError, CodecError: see `run`.
        """
        for session in self._plan.scorer:
            yield from self._rows(self._predictions, session.spans)

    def _score(self, core: Core, session: RowSession) -> Iterator[Message]:
        """What the scorer makes of its predictions, and of the requests that it was given between them."""
        requests = deque(self._plan.requests.get(session.producer, ()))
        for block in self._rows(self._predictions, session.spans):
            done = 0
            while requests and requests[0][0] <= block.t_ns[-1]:
                after_t_ns, request = requests.popleft()
                row = max(done, int(np.searchsorted(block.t_ns, after_t_ns, side="right")))
                if row > done:
                    yield from core.step(cut(block, done, row))
                    done = row
                self._observe(request)
                yield from core.step(request)
            if done < len(block.t_ns):
                yield from core.step(cut(block, done, len(block.t_ns)) if done else block)
        for _, request in requests:
            self._observe(request)
            yield from core.step(request)

    @property
    def raw_missing(self) -> int:
        """Raw messages that a stage took, or that lie between those that are there, and that the recording lacks."""
        return sum(self._holes.values())

    def _count(self, score: Score) -> None:
        new = score.t_ns > self._scored_t_ns
        self._scored_t_ns = max(self._scored_t_ns, int(score.t_ns[-1]))
        self.samples += int(new.sum())
        self.judged += int(score.valid[new].any(axis=1).sum())
        for why, count in zip(
            *np.unique(score.invalid_reason[new][~score.valid[new]], return_counts=True), strict=True
        ):
            self.not_judged[InvalidReason(why).name.lower()] += int(count)

    def _core(self, stage: str) -> Core:
        return load_stage(stage).build(self._contexts[stage]).core

    def _end(self, core: Core) -> Sequence[Message]:
        last = core.close()
        self.counts.update(core.counters())
        return last

    def _rows(self, streams: dict[str, _Stream[_Rows]], spans: Iterable[RowSpan]) -> Iterator[_Rows]:
        for span in spans:
            for block in streams[span.producer].of(span, self._kept_from[id(span)]):
                self._observe(block)
                yield block

    def _predict(self, session: RowSession) -> Iterator[Prediction]:
        core = self._core("twin_integrator")
        for grid in self._rows(self._grids, session.spans):
            for message in core.step(grid):
                if isinstance(message, Prediction):
                    yield message
                else:
                    self._observe(message)
        self._end(core)

    def _resample(self, session: ResamplerSession) -> Iterator[Grid]:
        core: Any = self._core("resampler")
        for block, passed_t_ns in self._blocks_of(session):
            yield from core.step(block)
            if passed_t_ns is not None:
                yield from core.give_up_until(passed_t_ns)
        last: Any = self._end(core)
        yield from last

    def _blocks_of(self, session: ResamplerSession) -> Iterator[tuple[Raw, int | None]]:
        """Blocks of the raw samples of a session, each ended where time is known to have passed; then until when."""
        waiting: list[bytes] = []
        kind: tuple[str, bool] | None = None  # of those that wait: from whom, and whether no session has had them
        for producer, sequence, payload in self._raw_of(session.spans):
            is_new = sequence >= self._taken.get(producer, 0)
            if (producer, is_new) != kind or len(waiting) >= BLOCK:
                yield from self._decoded(waiting, kind)
                waiting, kind = [], (producer, is_new)
            if is_new:
                self._taken[producer] = sequence + 1
            waiting.append(payload)
            passed_t_ns = session.passed.get((producer, sequence))
            if passed_t_ns is not None:
                *blocks, (last, _) = self._decoded(waiting, kind)
                yield from blocks
                yield last, passed_t_ns
                waiting = []
        yield from self._decoded(waiting, kind)

    def _decoded(self, waiting: Sequence[bytes], kind: tuple[str, bool] | None) -> Iterator[tuple[Raw, int | None]]:
        for block in decode_together(Raw, waiting):
            stretch = self._of_stretch(block)
            if kind and kind[1]:
                self._observe(stretch)
            if len(stretch.host_receive_t_ns):
                yield stretch, None

    def _of_stretch(self, block: Raw) -> Raw:
        """What lies within the stretch that is judged."""
        if self._stretch_s == (0.0, math.inf) or not len(block.host_receive_t_ns):
            return block
        if self._began_t_ns is None:
            self._began_t_ns = int(block.host_receive_t_ns[0])
        since_s = (block.host_receive_t_ns - self._began_t_ns) / 1e9
        inside = np.flatnonzero((since_s >= self._stretch_s[0]) & (since_s < self._stretch_s[1]))
        return cut(block, int(inside[0]), int(inside[-1]) + 1) if len(inside) else cut(block, 0, 0)

    def _raw_of(self, spans: Sequence[RawSpan]) -> Iterator[tuple[str, int, bytes]]:
        """Producer, sequence and bytes of the raw messages of spans, which go forward; each once.

        An open span goes on with whichever producer follows. What is missing is noted.
        """
        following: dict[str, int] = {}
        number, has_begun = 0, not spans[0].producer
        due: dict[str, int] = {spans[0].producer: spans[0].first} if spans[0].producer else {}
        for packet in self._raw():
            header = decode_header(packet)
            producer, sequence = header.producer, header.sequence
            if sequence < following.get(producer, 0):
                continue  # a part that overlaps the one before
            following[producer] = sequence + 1
            while not _is_in(spans[number], producer, sequence) and _is_of_later(spans, number, producer, sequence):
                self._note_hole(spans[number].producer, due, spans[number].known + 1)
                number += 1
                has_begun = False
                due[spans[number].producer] = spans[number].first
            span = spans[number]
            if _is_in(span, producer, sequence):
                has_begun = True
            elif producer == span.producer or not has_begun or span.last is not None:
                continue
            self._note_hole(producer, due, sequence)
            due[producer] = sequence + 1
            yield producer, sequence, packet.payload
        for span in spans[number:]:
            if span.producer:
                due[span.producer] = max(due.get(span.producer, 0), span.first)
                self._note_hole(span.producer, due, span.known + 1)

    def _note_hole(self, producer: str, due: dict[str, int], sequence: int) -> None:
        """Note that a producer's messages up to `sequence`, without it, are not there."""
        first = due.get(producer, sequence)
        if sequence > first:
            self._holes[producer, first] = max(self._holes.get((producer, first), 0), sequence - first)


def _is_in(span: RawSpan, producer: str, sequence: int) -> bool:
    return producer == span.producer and span.first <= sequence and (span.last is None or sequence <= span.last)


def _is_of_later(spans: Sequence[RawSpan], number: int, producer: str, sequence: int) -> bool:
    """Whether a message belongs to a span after this one, which so is over."""
    return any(span.producer == producer and sequence >= span.first for span in spans[number + 1 :])
