"""Reads the plan of a replay from a recording: what each session consumed, by the input positions of its outputs.

Where a recorder left outputs out, the stages' own reports of what they had consumed (`pipeline.runtime.publishing`)
take their place.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any

from fantwin.pipeline.replay.offline.plan import BEGINNING, Session, Span, TrayPlan, undisturbed_plan
from fantwin.pipeline.replay.stage_chain import StageChain
from fantwin.schemas.codec import CodecError
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import InputPosition
from fantwin.schemas.messages import (
    Alarm,
    Consumed,
    Grid,
    Message,
    ModelCard,
    Prediction,
    Request,
    Score,
    ScorerSnapshot,
)
from fantwin.schemas.streams import continues

NOT_VERIFIED = (
    "an alarm clip lacks what the stages had in memory where it begins: replay it without --verify to raise its alarms "
    "again, or verify the recording that it was cut from"
)


def plan_from_snapshot(
    chain: StageChain, snapshot: ScorerSnapshot, twins: Sequence[ModelCard], requests: Sequence[tuple[int, Request]]
) -> TrayPlan:
    """The plan of an alarm clip that begins in the middle of a scorer's session: one session of each stage.

    Such a clip lacks what the stages before the scorer had in memory. A replay runs them over the clip's raw samples,
    which begin early enough for them to settle; the scorer continues from the snapshot. The same alarms are raised,
    perhaps a few samples earlier or later: so a clip is not verified, but the recording from which it was cut.

    requests: each with the time after which it was answered.
    """
    plan = undisturbed_plan(chain, twins)
    (scorer,) = plan.last
    scorer.snapshot = snapshot
    scorer.spans = [Span("", snapshot.t_ns + 1, None)]
    scorer.requests = [(t_ns, request) for t_ns, request in requests if t_ns >= snapshot.t_ns]
    return plan


_NEVER_REACHED = "raw messages never reached {}, and the recording does not say which"


class PlanReader:
    """Reads a tray's outputs and side topics, in the order they were recorded."""

    def __init__(self, chain: StageChain, left_out: Collection[str] = ()) -> None:
        """left_out: topics that the recorder did not record."""
        self._left_out = left_out
        self._result = chain.outputs[-1]
        self._stages = {topic: stage.name for stage, topic in zip(chain.stages, chain.outputs, strict=True)}
        self._first = chain.stages[0].name
        self._sessions: dict[str, dict[str, Session]] = {stage.name: {} for stage in chain.stages}
        self._snapshots: dict[str, ScorerSnapshot] = {}
        self._saved_t_ns: dict[tuple[str, int], int] = {}
        """of each saved snapshot by producer and sequence"""
        self._known: dict[tuple[str, str], int] = {}
        """by producer of the last stage and of its input: up to when it is known to have scored"""
        self._requests: dict[str, Request] = {}
        self._twins: dict[tuple[str, int], ModelCard] = {}
        self._answers: dict[tuple[str, str], tuple[int, int]] = {}
        self._has_positions = True
        self.first_snapshot: ScorerSnapshot | None = None
        """the first one in the recording"""
        self.alarms: dict[tuple[str, int], Alarm] = {}
        """the recorded alarms by producer and sequence, each once"""
        self.undecodable = 0

    def add(self, envelope: Envelope) -> None:
        """Read the next message."""
        try:
            if envelope.topic in self._stages:
                self._extend(self._stages[envelope.topic], envelope.header, envelope.newest_t_ns, envelope)
            elif isinstance(message := envelope.message, Consumed):
                if message.topic in self._left_out:
                    self._extend(self._stages[message.topic], message.header, message.t_ns, envelope)
            else:
                self._add_side(message)
        except CodecError:
            self.undecodable += 1

    def plan(self) -> TrayPlan | None:
        """The sessions; None where the recording says of none what it consumed (`no_plan_reason`)."""
        plan = TrayPlan({stage: list(sessions.values()) for stage, sessions in self._sessions.items()})
        if not self._has_positions:
            return None
        if self._result in self._left_out:
            self._extend_last(plan.last)
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
    def answered_requests(self) -> list[tuple[int, Request]]:
        """The requests of operators, each with the time of the sample after which it was answered, in order."""
        answers = sorted(self._answers.items(), key=lambda answer: answer[1])
        return [(t_ns, self._requests[name]) for (_, name), (_, t_ns) in answers if name in self._requests]

    @property
    def no_plan_reason(self) -> str:
        """Why there is no plan."""
        if not self._has_positions:
            return "the scores have no input positions: nothing to compare with"
        empty = [topic for topic, stage in self._stages.items() if not self._sessions[stage]]
        lacking = "it does not say what the scorer consumed"
        if empty:
            lacking = f"it has no {'reports' if empty[0] in self._left_out else 'messages'} of topic {empty[0]}"
        return f"{lacking}: nothing to compare with"

    def _extend(self, stage: str, header: Any, newest_t_ns: int, envelope: Envelope) -> None:
        """Add to the session of a stage what it consumed up to an output.

        header: of the output, or of a report of it, which are numbered each by themselves. newest_t_ns: time of the
        newest sample of the output.
        """
        position: InputPosition | None = header.input_position
        if position is None or not position.consumed_count:
            self._has_positions = False
            return
        sessions = self._sessions[stage]
        session = sessions.get(header.producer)
        if session is None:
            # the first stage consumes messages without making output; the others answer the first message at once
            began_before = stage != self._first and position.consumed_count > 1
            lacks_outputs = stage != self._first and header.sequence > 0
            session = sessions[header.producer] = Session(header.producer, began_before, lacks_outputs)
        elif header.sequence < session.next_number:
            return  # this part of the recording overlaps the one before
        if stage == self._first:
            _extend_by_messages(session, position, newest_t_ns)
        elif session.position and continues(session.position, position):
            session.spans[-1].last = newest_t_ns
        else:
            if (
                session.position and header.sequence > session.next_number
            ):  # it may have consumed samples of any producer
                session.set_limit(session.last_t_ns, f"what {session.producer} consumed next was not recorded")
            session.spans.append(Span(position.producer, _first_t_ns(envelope.message), newest_t_ns))
        session.position = position
        session.next_number, session.last_t_ns = header.sequence + 1, newest_t_ns

    def _extend_last(self, sessions: Iterable[Session]) -> None:
        """A killed session has not reported its last outputs: its alarms and snapshots show that it went on."""
        for session in sessions:
            span = session.spans[-1]
            known_t_ns = self._known.get((session.producer, span.producer), session.last_t_ns)
            session.last_t_ns = max(session.last_t_ns, known_t_ns)
            if span.last is not None:
                span.last = max(span.last, session.last_t_ns)

    def _add_side(self, message: Message) -> None:
        header = message.header
        if isinstance(message, Alarm | ScorerSnapshot) and (position := header.input_position):
            key = header.producer, position.producer
            self._known[key] = max(message.t_ns, self._known.get(key, message.t_ns))
        if isinstance(message, ScorerSnapshot):
            self.first_snapshot = self.first_snapshot or message
            if message.restored:
                self._snapshots.setdefault(header.producer, message)
            else:
                self._saved_t_ns.setdefault((header.producer, header.sequence), message.t_ns)
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
            session.snapshots_t_ns = [t_ns for (saved_by, _), t_ns in self._saved_t_ns.items() if saved_by == producer]
        for (producer, name), (_, t_ns) in sorted(self._answers.items(), key=lambda answer: answer[1]):
            if name in self._requests and producer in sessions:
                sessions[producer].requests.append((t_ns, self._requests[name]))


def _first_t_ns(message: Message) -> int:
    """Time of the first sample of an output, or of the output of a report."""
    if isinstance(message, Consumed):
        return message.first_t_ns
    assert isinstance(message, Grid | Prediction | Score)
    return int(message.t_ns[0])


def _extend_by_messages(session: Session, position: InputPosition, newest_t_ns: int) -> None:
    before = session.position
    if before is None:
        first = max(0, position.sequence - position.consumed_count + 1)
        session.spans.append(Span(position.producer, first, position.sequence))
        if position.contiguous_from > first:
            session.set_limit(BEGINNING, _NEVER_REACHED.format(session.producer))
    elif continues(before, position):
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
        session.timer_outputs[position.producer, position.sequence] = newest_t_ns


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
