"""Which input each session of each stage consumed, reconstructed from the input positions of its outputs.

A stage that was killed restarts and consumes again the messages that its producers still keep. To make the same
decisions, a replay must feed each session what the recorded session consumed. Raw messages are identified by their
sequence number; samples of grids, predictions and scores by their time.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from pipeline.replay.stage_chain import StageChain
from schemas import fan_pb2
from schemas.codec import CodecError
from schemas.envelope import Envelope
from schemas.fast_decode import decode_header
from schemas.messages import Alarm, Grid, Message, ModelCard, Prediction, Request, Score, ScorerSnapshot

BEGINNING = -(2**63)
RAW_MISSING = "{raw_missing}"
"""in a reason: their number, which is known only at the end"""

_NEVER_REACHED = "raw messages never reached {}, and the recording does not say which"


class Limit(NamedTuple):
    """Up to where the outputs of a session can be reproduced."""

    t_ns: int
    """time of the last such sample; BEGINNING: none"""
    reason: str
    """why not those after it"""


@dataclass
class Span:
    """Input of one producer, from `first` to `last`, both included: sequence numbers of raw messages, times in ns of
    samples."""

    producer: str
    """"" is any producer of raw messages"""
    first: int
    last: int | None
    """None: to the end"""
    last_known: int = -1
    """the newest raw message that was certainly consumed"""
    wanted_again_from: int | None = None
    """the earliest sample that a later span of this producer contains; None: there is no such span"""


@dataclass
class Session:
    """One run of a stage's process, and what it consumed."""

    producer: str
    began_before: bool = False
    """it had consumed input before its first recorded output"""
    lacks_outputs: bool = False
    """it consumes samples, and had made output before its first recorded output"""
    spans: list[Span] = field(default_factory=list)
    timer_outputs: dict[tuple[str, int], int] = field(default_factory=dict)
    """of the first stage: after which raw message (producer, sequence) a timer made it emit samples, and until when"""
    limit: Limit | None = None
    """None: the recording holds all that the session consumed, as far as is known"""
    snapshot: ScorerSnapshot | None = None
    """what it was restored from"""
    requests: list[tuple[int, Request]] = field(default_factory=list)
    """operators' requests, each with the time of the sample after which it was answered, in order"""
    twins: list[ModelCard] = field(default_factory=list)
    """learned twins: of an integrator those that it used, each with its first sample; of a scorer all of the tray"""
    last_t_ns: int = 0
    """time of the newest sample in its recorded output"""
    next_sequence: int = 0
    position: fan_pb2.InputPosition | None = None
    """of its newest recorded output"""

    def set_limit(self, t_ns: int, reason: str) -> None:
        """Its outputs after `t_ns` cannot be reproduced. The earliest limit holds."""
        if self.limit is None or t_ns < self.limit.t_ns:
            self.limit = Limit(t_ns, reason)


@dataclass
class TrayPlan:
    """All sessions of one tray's stages."""

    sessions: dict[str, list[Session]]
    """by stage in the order of the chain, each list in the order the sessions began"""
    uses_recorded_snapshots: bool = True
    """False, with another twin or configuration: a session is restored from what the replayed one before it left"""

    @property
    def first(self) -> list[Session]:
        """The sessions of the stage that reads raw samples."""
        return next(iter(self.sessions.values()))

    @property
    def last(self) -> list[Session]:
        """The sessions of the stage that makes the decisions."""
        return list(self.sessions.values())[-1]

    def without_learned_twins(self) -> None:
        """Let all sessions use the twin that they are built with."""
        for session in (session for sessions in self.sessions.values() for session in sessions):
            session.twins = []

    @property
    def restarts(self) -> int:
        """How many sessions followed another one."""
        return sum(len(sessions) - 1 for sessions in self.sessions.values())


def undisturbed_plan(chain: StageChain, twins: Iterable[ModelCard] = ()) -> TrayPlan:
    """One session of each stage, which consumes everything there is. twins: the learned ones, each with its first
    sample."""
    first, *others = (stage.name for stage in chain.stages)
    raw = Session("", spans=[Span("", 0, None)])
    of_all = list(twins)
    return TrayPlan(
        {first: [raw]} | {name: [Session("", spans=[Span("", BEGINNING, None)], twins=of_all)] for name in others}
    )


class NoInputPositionError(Exception):
    """An output does not say which input it was made from."""


def limit_through(session: Session, upstream: dict[str, Limit | None]) -> Limit | None:
    """The limit of a session that consumes samples of others, whose limits are `upstream` by producer."""
    for span in session.spans:
        limit = upstream.get(span.producer)
        if limit is not None and (span.last is None or span.last > limit.t_ns):
            until_t_ns = max(limit.t_ns, span.first - 1 if span.first > BEGINNING else BEGINNING)
            if session.limit is None or until_t_ns < session.limit.t_ns:
                return Limit(until_t_ns, limit.reason)
            break
    return session.limit


class PlanReader:
    """Reads a tray's outputs and side topics, in the order they were recorded."""

    def __init__(self, chain: StageChain) -> None:
        self._stages = {topic: stage.name for stage, topic in zip(chain.stages, chain.outputs, strict=True)}
        self._first = chain.stages[0].name
        self._sessions: dict[str, dict[str, Session]] = {stage.name: {} for stage in chain.stages}
        self._snapshots: dict[str, ScorerSnapshot] = {}
        self._requests: dict[str, Request] = {}
        self._twins: dict[tuple[str, int], ModelCard] = {}
        self._answers: dict[tuple[str, str], tuple[int, int]] = {}
        self._has_positions = True
        self.alarms: dict[tuple[str, int], Alarm] = {}
        """the recorded alarms by producer and sequence, each once"""
        self.undecodable = 0

    def add(self, envelope: Envelope) -> None:
        """Read the next message."""
        try:
            if envelope.topic not in self._stages:
                self._add_side(envelope.message)
            elif self._has_positions:
                self._add_output(envelope)
        except NoInputPositionError:
            self._has_positions = False
        except CodecError:
            self.undecodable += 1

    def plan(self) -> TrayPlan | None:
        """The sessions; None where the recording says of none what it consumed (`no_plan_reason`)."""
        plan = TrayPlan({stage: list(sessions.values()) for stage, sessions in self._sessions.items()})
        if not self._has_positions:
            return None
        producing, *consuming = plan.sessions.values()
        for stage, sessions in zip(list(plan.sessions)[1:], consuming, strict=True):
            _drop_unknown_producers(sessions, {session.producer for session in producing})
            plan.sessions[stage] = producing = [session for session in sessions if session.spans]
        if not all(plan.sessions.values()):
            return None
        _open_ends(plan)
        _find_repeats(plan)
        self._add_sides(plan)
        _limit_unknown_beginnings(plan)
        return plan

    @property
    def twins(self) -> list[ModelCard]:
        """The learned twins, each with its first sample, in order."""
        return sorted(self._twins.values(), key=lambda card: card.t_ns)

    @property
    def no_plan_reason(self) -> str:
        """Why there is no plan."""
        if not self._has_positions:
            return "the scores have no input positions: nothing to compare with"
        empty = [topic for topic, stage in self._stages.items() if not self._sessions[stage]]
        lacking = f"it has no messages of topic {empty[0]}" if empty else "it does not say what the scorer consumed"
        return f"{lacking}: nothing to compare with"

    def _add_output(self, envelope: Envelope) -> None:
        header = decode_header(envelope)
        if not header.HasField("input_position"):
            raise NoInputPositionError
        stage = self._stages[envelope.topic]
        position, sessions = header.input_position, self._sessions[stage]
        session = sessions.get(header.producer)
        if session is None:
            # the first stage consumes messages without making output; the others answer the first message at once
            began_before = stage != self._first and position.consumed_count > 1
            lacks_outputs = stage != self._first and header.sequence > 0
            session = sessions[header.producer] = Session(header.producer, began_before, lacks_outputs)
        elif header.sequence < session.next_sequence:
            return  # this part of the recording overlaps the one before
        if stage == self._first:
            _extend_by_messages(session, position, envelope)
        else:
            _extend_by_samples(session, position, envelope, lacks_outputs=header.sequence > session.next_sequence)
        session.position = position
        session.next_sequence, session.last_t_ns = header.sequence + 1, envelope.newest_t_ns

    def _add_side(self, message: Message) -> None:
        header = message.header
        if isinstance(message, ScorerSnapshot) and message.restored:
            self._snapshots.setdefault(header.producer, message)
        elif isinstance(message, Request):
            self._requests[f"{header.producer}/{header.sequence}"] = message
        elif isinstance(message, ModelCard):
            if message.content:
                self._twins.setdefault((header.producer, header.sequence), message)
        elif isinstance(message, Alarm):
            self.alarms.setdefault((header.producer, header.sequence), message)
            if message.request:
                self._answers.setdefault((header.producer, message.request), (header.sequence, message.t_ns))

    def _add_sides(self, plan: TrayPlan) -> None:
        for of_stage in list(plan.sessions.values())[1:-1]:
            for session in of_stage:
                session.twins = [card for card in self.twins if card.header.producer == session.producer]
        sessions = {session.producer: session for session in plan.last}
        for producer, session in sessions.items():
            session.twins = self.twins
            session.snapshot = self._snapshots.get(producer)
        for (producer, name), (_, t_ns) in sorted(self._answers.items(), key=lambda answer: answer[1]):
            if name in self._requests and producer in sessions:
                sessions[producer].requests.append((t_ns, self._requests[name]))


def _extend_by_messages(session: Session, position: fan_pb2.InputPosition, envelope: Envelope) -> None:
    before = session.position
    if before is None:
        first = max(0, position.sequence - position.consumed_count + 1)
        session.spans.append(Span(position.producer, first, position.sequence))
        if position.contiguous_from > first:
            session.set_limit(BEGINNING, _NEVER_REACHED.format(session.producer))
    elif _continues(before, position):
        session.spans[-1].last = position.sequence
    else:
        # Some messages never arrived, or another producer follows. The consumed messages that the counts show before
        # `contiguous_from` were those right after the last known one, unless there was more than one gap.
        newly_contiguous = position.sequence - position.contiguous_from + 1
        earlier = position.consumed_count - before.consumed_count - newly_contiguous
        if earlier != 0:
            session.set_limit(session.last_t_ns, _NEVER_REACHED.format(session.producer))
        session.spans[-1].last = before.sequence + max(earlier, 0)
        session.spans.append(Span(position.producer, position.contiguous_from, position.sequence))
    session.spans[-1].last_known = position.sequence
    if position.from_timer:
        session.timer_outputs[position.producer, position.sequence] = envelope.newest_t_ns


def _extend_by_samples(
    session: Session, position: fan_pb2.InputPosition, envelope: Envelope, *, lacks_outputs: bool
) -> None:
    """lacks_outputs: the recording lacks outputs of the session right before this one."""
    before = session.position
    if before and _continues(before, position):
        session.spans[-1].last = envelope.newest_t_ns
    else:
        if before and lacks_outputs:  # it may have consumed samples of any producer in between
            session.set_limit(session.last_t_ns, f"what {session.producer} consumed next was not recorded")
        message = envelope.message
        assert isinstance(message, Grid | Prediction | Score)
        session.spans.append(Span(position.producer, int(message.t_ns[0]), envelope.newest_t_ns))


def _continues(before: fan_pb2.InputPosition, position: fan_pb2.InputPosition) -> bool:
    """Whether nothing is missing between two positions."""
    return position.producer == before.producer and position.contiguous_from <= before.sequence + 1


def _drop_unknown_producers(sessions: list[Session], known: set[str]) -> None:
    for session in sessions:
        unknown = next((span for span in session.spans if span.producer not in known), None)
        if unknown:
            before = session.spans[: session.spans.index(unknown)]
            last = before[-1].last if before else None
            session.set_limit(
                BEGINNING if last is None else last,
                f"{session.producer} consumed what {unknown.producer} made, and nothing of that was recorded",
            )
            session.spans = [span for span in session.spans if span.producer in known]


def _limit_unknown_beginnings(plan: TrayPlan) -> None:
    for sessions in plan.sessions.values():
        for number, session in enumerate(sessions):
            if session.lacks_outputs or (session.began_before and session.snapshot is None):
                reason = (
                    f"the first messages of {session.producer} were not recorded"
                    if number
                    else f"the recording begins in the middle of {session.producer}: name the parts before it as well"
                )
                session.set_limit(BEGINNING, reason)


def _open_ends(plan: TrayPlan) -> None:
    """Let sessions produce more than was recorded of them, as far as the next stage needs it.

    The last messages of a killed session may have reached the next stage and not the recorder. What the last sessions
    had not yet consumed when the recording ended is processed as well.
    """
    *producing, deciding = plan.sessions.values()
    for session in (*(session for sessions in producing for session in sessions), deciding[-1]):
        session.spans[-1].last = None
    for sessions, consuming in zip(producing, [*producing[1:], deciding], strict=True):
        spans = consuming[-1].spans
        names = [session.producer for session in sessions]
        if spans[-1].producer in names:
            spans += [Span(name, BEGINNING, None) for name in names[names.index(spans[-1].producer) + 1 :]]


def _find_repeats(plan: TrayPlan) -> None:
    """Set `wanted_again_from` of every span of samples."""
    for sessions in list(plan.sessions.values())[1:]:
        wanted: dict[str, int] = {}
        for span in reversed([span for session in sessions for span in session.spans]):
            span.wanted_again_from = wanted.get(span.producer)
            wanted[span.producer] = min(span.first, wanted.get(span.producer, span.first))
