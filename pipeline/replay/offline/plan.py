"""The plan of a replay: which input each session of each stage consumed.

A stage that was killed restarts and consumes again the messages that its producers still keep. To make the same
decisions, a replay must feed each session what the recorded session consumed. Raw messages are identified by their
sequence number; samples of grids, predictions and scores by their time. `pipeline.replay.offline.plan_reader` finds
the plan of a recording.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from fantwin.pipeline.replay.stage_chain import StageChain
from fantwin.schemas.header import InputPosition
from fantwin.schemas.messages import ModelCard, Request, ScorerSnapshot

BEGINNING = -(2**63)
RAW_MISSING = "{raw_missing}"
"""in a reason: their number, which is known only at the end"""


class Limit(NamedTuple):
    """Up to where the outputs of a session can be reproduced."""

    t_ns: int
    """time of the last such sample; BEGINNING: none"""
    reason: str
    """why not those after it"""


UNLIMITED = Limit(2**63 - 1, "")
"""of a session of which everything can be reproduced"""


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
    """time of the newest sample in its recorded output, or in what else it is known to have made"""
    next_number: int = 0
    """of its outputs or reports"""
    position: InputPosition | None = None
    """of its newest recorded output"""
    snapshots_t_ns: list[int] = field(default_factory=list)
    """when it took the recorded snapshots, in order: a replay takes its own there, because evidence is rounded then"""

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
