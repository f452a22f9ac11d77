"""The health of a stage: what it received and published, what it counts, and what is wrong."""

from __future__ import annotations

from dataclasses import dataclass

from fantwin.schemas.enums import StageStatus
from fantwin.schemas.fan_names import FanNames
from fantwin.schemas.header import Header


@dataclass(frozen=True, kw_only=True)
class Counter:
    """One counter of a stage; it only grows within a session."""

    name: str
    value: int


@dataclass(frozen=True, kw_only=True)
class Input:
    """One input of a stage: messages on one key from one producer.

    Attributes:
        missing: gaps in the sequence, never filled.
        missing_at_start: those of them before the first message that was received.
        unsaved: the last of the received ones, so many, that are lost if the stage is killed now.
    """

    key: str
    producer: str
    received: int
    missing: int
    duplicated: int
    next_sequence: int
    missing_at_start: int = 0
    unsaved: int = 0


@dataclass(frozen=True, kw_only=True)
class Output:
    """One output of a stage.

    Attributes:
        published: the number of messages, which is also the next sequence number.
        has_more: input of its tray waits from which more may still be made, so `published` does not show a silent
            source.
    """

    key: str
    published: int
    has_more: bool = False


@dataclass(frozen=True, kw_only=True)
class AwaitedInput:
    """An input that a stage waits for, and since when, host time."""

    key: str
    since_t_ns: int


@dataclass(frozen=True, kw_only=True)
class Note:
    """What a stage works with and has done for a tray, one line; an empty tray: for all."""

    tray: str
    text: str


@dataclass(frozen=True, kw_only=True)
class NamedFan:
    """What people call a fan, and where it is; empty: not known."""

    name: str = ""
    place: str = ""


@dataclass(frozen=True, kw_only=True)
class FanLearning:
    """How far a fan is on the way to its first twin, 0 to 1. missing: what it has not done yet, in words."""

    progress: float
    missing: str


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """What an operator may ask of a learner: to move the fans of a tray over their range.

    Attributes:
        plan: which fans it moves between which commands, and for how long.
        running: what it does now; empty: none runs.
        ended: how the last one ended, or why it was not begun; empty: there was none.
        asked_t_ns: time of the last request that was taken.
    """

    plan: str
    running: str = ""
    ended: str = ""
    asked_t_ns: int = 0


@dataclass(frozen=True, kw_only=True)
class Learning:
    """What the first twin of a tray waits for.

    Attributes:
        tray: added by the runner of the stage.
        until_t_ns: when it will be learned; 0: not known, as that depends on the fans.
        helps: what would make it sooner, in words; empty: nothing would.
        sweep: None: nobody may ask for one.
    """

    tray: str
    what: str
    until_t_ns: int
    helps: str
    fans: tuple[FanLearning, ...]
    sweep: Sweep | None = None


@dataclass(frozen=True, kw_only=True)
class AcceptedSamples:
    """What an acquisition accepts of the clients that push samples of a tray; commands in the tray's unit."""

    tray: str
    fans: int
    command_min: float
    command_max: float
    speed_max_rad_s: float
    named: tuple[NamedFan, ...] = ()

    @property
    def names(self) -> FanNames:
        """Names of the fans."""
        return FanNames(tuple(fan.name for fan in self.named))


@dataclass(frozen=True, kw_only=True)
class LatencyBucket:
    """How many outputs were at most `upper_s` old when they were sent; the last bucket has no limit.

    They count from when the stage had caught up with what came before its start.
    """

    upper_s: float
    count: int


@dataclass(frozen=True, eq=False, kw_only=True)
class Health:
    """Status of a process of a stage, and what it has received, sent and lost.

    Attributes:
        latency_p50_ms: of the outputs of the last ten seconds, as latency_p99_ms.
        latencies: a histogram of all outputs of its session, whose latencies add up to latency_sum_s; a stage without
            outputs sends none.
        trays: names of its trays, separated by commas; empty: all of the site.
        learning: of trays without a twin.
        is_last: the last message of its session, whatever its status.
    """

    header: Header = Header()
    stage: str
    instance: str
    status: StageStatus
    t_ns: int
    uptime_s: float
    problem: str = ""
    inputs: tuple[Input, ...] = ()
    outputs: tuple[Output, ...] = ()
    counters: tuple[Counter, ...] = ()
    latency_p50_ms: float = 0.0
    latency_p99_ms: float = 0.0
    lost: int = 0
    process_id: int = 0
    waiting_for: tuple[AwaitedInput, ...] = ()
    newest_input_t_ns: int = 0
    newest_output_t_ns: int = 0
    notes: tuple[Note, ...] = ()
    trays: str = ""
    accepts: tuple[AcceptedSamples, ...] = ()
    is_last: bool = False
    latencies: tuple[LatencyBucket, ...] = ()
    latency_sum_s: float = 0.0
    learning: tuple[Learning, ...] = ()
