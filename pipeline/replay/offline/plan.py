"""What every session of every stage was fed, read from a recording: the causes that its messages carry.

A stage that was killed begins anew, catches up with what its producers still keep, and so takes some messages again
that its predecessor had taken. A replay that is to decide the same must do the same. Times are those of grid samples,
which name the rows of grids, predictions and scores alike; raw messages are named by their sequence.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from schemas import fan_pb2
from schemas.envelope import Envelope
from schemas.fast_decode import decode_header
from schemas.messages import Alarm, Grid, Message, Prediction, Request, Score, ScorerSnapshot

CHAIN = {"resampler": "grid", "twin_integrator": "prediction", "scorer": "score"}
"""The stages that decide, in the order of the data, and the topic whose rows tell what each was fed."""

SIDE_TOPICS = ("alarm", "snapshot", "request")


@dataclass
class RawSpan:
    """Messages first..last of one producer of raw samples, "" for all of them; None: to the end."""

    producer: str
    first: int
    last: int | None
    known: int = -1
    """the newest that was certainly taken"""


@dataclass
class RowSpan:
    """Rows first_t_ns..last_t_ns of one producer; None: from the beginning, to the end."""

    producer: str
    first_t_ns: int | None
    last_t_ns: int | None


@dataclass
class ResamplerSession:
    """A session of the resampler. `passed`: after which raw message of a producer time passed, and to which sample."""

    producer: str
    spans: list[RawSpan] = field(default_factory=list)
    passed: dict[tuple[str, int], int] = field(default_factory=dict)
    is_guessed: bool = False
    """some messages never came to it, and which is not known for certain"""


@dataclass
class RowSession:
    """A session of a stage that takes rows."""

    producer: str
    spans: list[RowSpan] = field(default_factory=list)


@dataclass
class TrayPlan:
    """All sessions of one tray, in the order they came."""

    resampler: list[ResamplerSession]
    twin_integrator: list[RowSession]
    scorer: list[RowSession]
    began_before: set[str]
    """sessions that had taken something before the recording begins: they cannot be made the same again"""
    last_scored_t_ns: dict[str, int]
    """of each session of the scorer, the newest sample whose score is recorded"""
    snapshots: dict[str, ScorerSnapshot] = field(default_factory=dict)
    """what sessions of the scorer began with"""
    is_as_recorded: bool = True
    """what is judged by is the recording's own; else a session goes on from what the one before finds now"""
    requests: dict[str, list[tuple[int, Request]]] = field(default_factory=dict)
    """of each session of the scorer: what operators asked for, and after which sample, in order"""

    @property
    def restarts(self) -> int:
        """How many sessions followed another one."""
        return sum(len(sessions) - 1 for sessions in (self.resampler, self.twin_integrator, self.scorer))


def undisturbed() -> TrayPlan:
    """One session of each stage that takes everything there is."""
    rows = [RowSession("", [RowSpan("", None, None)])]
    return TrayPlan([ResamplerSession("", [RawSpan("", 0, None)])], rows, rows, set(), {})


class UnplannedError(Exception):
    """A recording whose messages do not say what they were made of."""


class Planner:
    """Takes the packets of one tray of `CHAIN`'s topics, in the order they were recorded."""

    def __init__(self) -> None:
        self._books = {topic: _Book(topic) for topic in CHAIN.values()}

    def note(self, packet: Envelope) -> None:
        """Take the next one.

        Raises:
            UnplannedError: it does not say what it was made of.
            CodecError: it cannot be decoded.
        """
        self._books[packet.topic].note(packet)

    def plan(self) -> TrayPlan | None:
        """The sessions; None where what is recorded does not tell all of them."""
        grids, predictions, scores = (list(book.sessions.values()) for book in self._books.values())
        if not all(session.spans for session in (*predictions, *scores)):
            return None  # of another version: their rows cannot be read
        for made, fed in ((predictions, grids), (scores, predictions)):
            known = {session.producer for session in fed}
            if not made or not all(span.producer in known for session in made for span in session.spans):
                return None
        plan = TrayPlan(
            [ResamplerSession(s.producer, s.raw_spans, s.passed, s.is_guessed) for s in grids],
            [RowSession(session.producer, session.spans) for session in predictions],
            [RowSession(session.producer, session.spans) for session in scores],
            {session.producer for session in (*predictions, *scores) if session.began_before},
            {session.producer: session.newest_t_ns for session in scores},
        )
        _open_the_ends(plan)
        return plan


class SideInputs:
    """What the scorer was given besides predictions; its own answers tell when."""

    def __init__(self) -> None:
        self.snapshots: dict[str, ScorerSnapshot] = {}
        self._requests: dict[str, Request] = {}
        self._answers: dict[tuple[str, str], tuple[int, int]] = {}

    def note(self, message: Message) -> None:
        """Take the next message of the topics `memory`, `request` and `alarm`."""
        producer, sequence = message.header.producer, message.header.sequence
        if isinstance(message, ScorerSnapshot) and message.restored:
            self.snapshots.setdefault(producer, message)
        elif isinstance(message, Request):
            self._requests[f"{producer}/{sequence}"] = message
        elif isinstance(message, Alarm) and message.request:
            self._answers.setdefault((producer, message.request), (sequence, message.t_ns))

    def add_to(self, plan: TrayPlan, *, is_as_recorded: bool) -> None:
        """Tell a plan of them. A session that began with a memory needs nothing of what came before it."""
        plan.snapshots = self.snapshots
        plan.is_as_recorded = is_as_recorded
        plan.began_before -= set(self.snapshots)
        for (producer, name), (_, t_ns) in sorted(self._answers.items(), key=lambda answer: answer[1]):
            if name in self._requests:
                plan.requests.setdefault(producer, []).append((t_ns, self._requests[name]))


@dataclass
class _Session:
    """What is known of one session from its outputs so far."""

    producer: str
    began_before: bool
    spans: list[RowSpan]
    raw_spans: list[RawSpan]
    passed: dict[tuple[str, int], int]
    next_sequence: int = 0
    newest_t_ns: int = 0
    cause_producer: str = ""
    cause_sequence: int = 0
    taken: int = 0
    is_guessed: bool = False


class _Book:
    """Follows the outputs of one topic."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self.sessions: dict[str, _Session] = {}

    def note(self, packet: Envelope) -> None:
        header = decode_header(packet)
        if not header.HasField("input_position"):
            raise UnplannedError
        position = header.input_position
        session = self.sessions.get(header.producer)
        if session is None:
            session = self.sessions[header.producer] = _Session(
                producer=header.producer,
                # the resampler takes raw messages that give no grid yet, the others answer the first at once
                began_before=self._topic != "grid" and position.consumed_count > 1,
                spans=[],
                raw_spans=[
                    RawSpan(
                        position.producer, max(0, position.sequence - position.consumed_count + 1), position.sequence
                    )
                ],
                passed={},
            )
        elif header.sequence < session.next_sequence:
            return  # a part that overlaps the one before
        else:
            self._follow_raw(session, position)
        if self._topic == "grid":
            if position.from_timer:
                session.passed[position.producer, position.sequence] = packet.newest_t_ns
        else:
            self._follow_rows(session, position, packet)
        session.raw_spans[-1].known = position.sequence
        session.next_sequence, session.newest_t_ns = header.sequence + 1, packet.newest_t_ns
        session.cause_producer, session.cause_sequence, session.taken = (
            position.producer,
            position.sequence,
            position.consumed_count,
        )

    def _follow_raw(self, session: _Session, position: fan_pb2.InputPosition) -> None:
        span = session.raw_spans[-1]
        if position.producer == span.producer and position.contiguous_from <= session.cause_sequence + 1:
            span.last = position.sequence
            return
        # Some never came, or another producer has followed. Before `since` there were some of the former that gave
        # nothing: those right after the last, unless there was more than one hole.
        before = position.consumed_count - session.taken - (position.sequence - position.contiguous_from + 1)
        session.is_guessed |= before != 0
        span.last = session.cause_sequence + max(before, 0)
        session.raw_spans.append(RawSpan(position.producer, position.contiguous_from, position.sequence))

    def _follow_rows(self, session: _Session, position: fan_pb2.InputPosition, packet: Envelope) -> None:
        goes_on = position.producer == session.cause_producer and position.contiguous_from <= session.cause_sequence + 1
        if not session.spans or not goes_on:
            message = packet.message
            assert isinstance(message, Grid | Prediction | Score)
            session.spans.append(RowSpan(position.producer, int(message.t_ns[0]), packet.newest_t_ns))
        else:
            session.spans[-1].last_t_ns = packet.newest_t_ns


def _open_the_ends(plan: TrayPlan) -> None:
    """Let sessions make more than was recorded of them, as far as anyone wants it.

    The last messages of a session that was killed may have reached the scorer and not the recorder. And what the last
    sessions had still before them when the recording ended is judged all the same.
    """
    for session in plan.resampler:
        session.spans[-1].last = None
    for session in (*plan.twin_integrator, plan.scorer[-1]):
        session.spans[-1].last_t_ns = None
    for sessions, feeding in ((plan.twin_integrator, plan.resampler), (plan.scorer, plan.twin_integrator)):
        spans = sessions[-1].spans
        names = [session.producer for session in feeding]
        if spans[-1].producer in names:
            spans += [RowSpan(name, None, None) for name in names[names.index(spans[-1].producer) + 1 :]]
