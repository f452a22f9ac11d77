"""The messages as the stages see them: frozen dataclasses with NumPy columns.

Field names, order and units are those of `fan.proto`; a test holds the two together. Columns say their
shape in their type: `Samples` (n,), `SamplesFans` (n, fans), `Fans` (fans,).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]


class InvalidReason(IntEnum):
    """Why a sample must not be judged."""

    NONE = 0
    STALE = 1
    GAP = 2
    WARMING_UP = 3
    OUT_OF_RANGE = 4
    SATURATED = 5
    NO_SPEED = 6
    NO_TWIN = 7


class FanState(IntEnum):
    """What the scorer says of a fan at one sample."""

    UNKNOWN = 0
    NORMAL = 1
    SUSPECT = 2
    ALARM = 3
    RETURNING = 4
    COMMISSIONING = 5


class Statistic(IntEnum):
    """Which statistic is the furthest towards its limit."""

    NONE = 0
    SPEED_SMOOTHED = 1
    SPEED_DRIFT = 2
    SPEED_VARIANCE_GROWTH = 3
    BALANCE_SMOOTHED = 4
    BALANCE_DRIFT = 5
    BALANCE_VARIANCE_GROWTH = 6
    SENSOR = 7


class Transition(IntEnum):
    """What happened to an alarm, in the words of OPC UA Part 9."""

    NONE = 0
    RAISED = 1
    SEVERITY = 2
    DIAGNOSED = 3
    CLEARED = 4
    ACKNOWLEDGED = 5
    CONFIRMED = 6
    RESET = 7
    SHELVED = 8
    UNSHELVED = 9
    SUPPRESSED = 10
    UNSUPPRESSED = 11
    OUT_OF_SERVICE = 12
    IN_SERVICE = 13
    COMMISSIONING = 14
    REPUBLISHED = 15
    REFUSED = 16


class Action(IntEnum):
    """What an operator may ask for."""

    NONE = 0
    ACKNOWLEDGE = 1
    CONFIRM = 2
    RESET = 3
    SHELVE = 4
    UNSHELVE = 5
    SUPPRESS = 6
    UNSUPPRESS = 7
    OUT_OF_SERVICE = 8
    IN_SERVICE = 9
    COMMISSION = 10


class Severity(IntEnum):
    """How much an alarm matters."""

    NONE = 0
    WARNING = 1
    ALARM = 2


class StageStatus(IntEnum):
    """How a stage says it is."""

    STARTING = 0
    OK = 1
    DEGRADED = 2
    STOPPED = 3


@dataclass(frozen=True, slots=True)
class InputPosition:
    """What a stage had taken of its inputs, for one tray, when it made a message.

    `topic`, `producer` and `sequence` name the message taken last, `consumed_count` counts all, that one included.
    From `contiguous_from`
    on up to `sequence` none is missing. `from_timer`: made since, because time had passed or the stage ended, and not
    on
    taking it.
    """

    topic: str
    producer: str
    sequence: int
    consumed_count: int
    contiguous_from: int
    from_timer: bool = False

    @classmethod
    def after(cls, before: InputPosition | None, topic: str, header: Header) -> InputPosition:
        """What has been taken once a message with this header has, too."""
        follows = before is not None and (before.producer, before.sequence + 1) == (header.producer, header.sequence)
        return cls(
            topic=topic,
            producer=header.producer,
            sequence=header.sequence,
            consumed_count=before.consumed_count + 1 if before else 1,
            contiguous_from=before.contiguous_from if before and follows else header.sequence,
        )


@dataclass(frozen=True, slots=True)
class Header:
    """Who sent a message, which one of theirs it is, the tray it is about, and what it was made of."""

    producer: str = ""
    sequence: int = 0
    tray: str = ""
    input_position: InputPosition | None = None


def _column(shape: str, dtype: type) -> Any:
    """A column of one message: its shape in words, and the dtype its packed bytes have."""
    return field(default_factory=lambda: np.zeros(0, dtype), metadata={"shape": shape, "dtype": np.dtype(dtype)})


def _samples(dtype: type) -> Any:
    return _column("samples", dtype)


def _samples_fans(dtype: type) -> Any:
    return _column("samples x fans", dtype)


def _fans(dtype: type) -> Any:
    return _column("fans", dtype)


@dataclass(frozen=True, eq=False, kw_only=True)
class Raw:
    """Samples as the device sent them; `device_clock_us` and `device_sequence` are empty where it has none."""

    header: Header = Header()
    fans: int
    host_receive_t_ns: Array = _samples(np.int64)
    device_clock_us: Array = _samples(np.uint32)
    device_sequence: Array = _samples(np.uint32)
    command: Array = _samples_fans(np.float64)
    speed_rad_s: Array = _samples_fans(np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class Grid:
    """The samples on a uniform grid of time; command held, speed interpolated."""

    header: Header = Header()
    fans: int
    period_ns: int
    t_ns: Array = _samples(np.int64)
    command: Array = _samples_fans(np.float64)
    speed_rad_s: Array = _samples_fans(np.float64)
    valid: Array = _samples_fans(np.bool_)
    invalid_reason: Array = _samples_fans(np.uint8)


@dataclass(frozen=True, eq=False, kw_only=True)
class Prediction:
    """What the healthy twin says, in free run, beside what was measured."""

    header: Header = Header()
    fans: int
    period_ns: int
    t_ns: Array = _samples(np.int64)
    command: Array = _samples_fans(np.float64)
    measured_speed_rad_s: Array = _samples_fans(np.float64)
    predicted_speed_rad_s: Array = _samples_fans(np.float64)
    sigma_rad_s: Array = _fans(np.float64)
    valid: Array = _samples_fans(np.bool_)
    invalid_reason: Array = _samples_fans(np.uint8)
    twin: str = ""
    torque_balance_command: Array = _samples_fans(np.float64)
    torque_balance_sigma_command: Array = _fans(np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class Score:
    """A judged sample, with everything a viewer needs to draw it."""

    header: Header = Header()
    fans: int
    period_ns: int
    t_ns: Array = _samples(np.int64)
    command: Array = _samples_fans(np.float64)
    measured_speed_rad_s: Array = _samples_fans(np.float64)
    predicted_speed_rad_s: Array = _samples_fans(np.float64)
    lower_bound_rad_s: Array = _samples_fans(np.float64)
    upper_bound_rad_s: Array = _samples_fans(np.float64)
    band_variance: Array = _samples_fans(np.float64)
    residual_rad_s: Array = _samples_fans(np.float64)
    smoothed_residual_rad_s: Array = _samples_fans(np.float64)
    outside: Array = _samples_fans(np.bool_)
    state: Array = _samples_fans(np.uint8)
    valid: Array = _samples_fans(np.bool_)
    invalid_reason: Array = _samples_fans(np.uint8)
    torque_balance_command: Array = _samples_fans(np.float64)
    speed_baseline_rad_s: Array = _samples_fans(np.float64)
    balance_baseline_command: Array = _samples_fans(np.float64)
    score: Array = _samples_fans(np.float64)
    statistic: Array = _samples_fans(np.uint8)


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """One possible cause of an alarm, with what speaks for it."""

    cause: str
    probability: float
    parameter: str = ""
    change: float = 0.0
    change_low: float = 0.0
    change_high: float = 0.0
    unit: str = ""
    evidence: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class Alarm:
    """What happened to the alarm of a fan, and how it stands since; tray, fan and `onset_t_ns` name it."""

    header: Header = Header()
    fan: int
    active: bool
    severity: Severity
    t_ns: int
    onset_t_ns: int
    residual_rad_s: float
    limit_rad_s: float
    message: str
    transition: Transition = Transition.NONE
    statistic: Statistic = Statistic.NONE
    score: float = 0.0
    torque_balance_command: float = 0.0
    torque_balance_limit_command: float = 0.0
    acknowledged: bool = False
    confirmed: bool = False
    latched: bool = False
    shelved_until_t_ns: int = 0
    suppressed: bool = False
    out_of_service: bool = False
    causes: tuple[Diagnosis, ...] = ()
    request: str = ""
    operator_name: str = ""
    comment: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class Request:
    """What an operator wants of the alarms of a tray; fan -1 means all of them."""

    header: Header = Header()
    t_ns: int
    action: Action
    fan: int = -1
    duration_s: float = 0.0
    operator_name: str = ""
    comment: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScorerSnapshot:
    """What a scorer must not forget when it is restarted."""

    header: Header = Header()
    t_ns: int
    twin_sha256: str
    restored: bool = False
    state_json: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class Command:
    """What an operator or a controller wants of the fans; NaN leaves a fan as it is."""

    header: Header = Header()
    fans: int
    t_ns: int
    command: Array = _fans(np.float64)
    set_point_rad_s: Array = _fans(np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelCard:
    """The twin in force."""

    header: Header = Header()
    t_ns: int
    twin: str
    kind: str
    sha256: str
    sigma_rad_s: Array = _fans(np.float64)
    card_json: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class Clock:
    """What a replay has come to, in the recording's own time; `rate` is 0 while it is paused."""

    header: Header = Header()
    t_ns: int
    rate: float


@dataclass(frozen=True, kw_only=True)
class Counter:
    """One counter of a stage; grows only, within a session."""

    name: str
    value: int


@dataclass(frozen=True, kw_only=True)
class Input:
    """One input of a stage: the messages on one key from one producer."""

    key: str
    producer: str
    received: int
    missing: int
    duplicated: int
    next_sequence: int


@dataclass(frozen=True, kw_only=True)
class Output:
    """One output of a stage; `published` is also the next sequence number."""

    key: str
    published: int


@dataclass(frozen=True, eq=False, kw_only=True)
class Health:
    """How a stage is, what it has received, sent and lost."""

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


Message: TypeAlias = (
    Raw | Grid | Prediction | Score | Alarm | Request | ScorerSnapshot | Command | ModelCard | Clock | Health
)
MESSAGE_TYPES: tuple[type[Message], ...] = (
    Raw, Grid, Prediction, Score, Alarm, Request, ScorerSnapshot, Command, ModelCard, Clock, Health,
)  # fmt: skip


def newest_t_ns(message: Message) -> int:
    """The time of the newest sample (or of the event) a message is about, ns since the epoch; 0 if it has none."""
    if isinstance(message, Raw):
        times = message.host_receive_t_ns
    elif isinstance(message, Grid | Prediction | Score):
        times = message.t_ns
    else:
        return message.t_ns
    return int(times[-1]) if len(times) else 0


def columns(message_type: type[Message]) -> dict[str, tuple[str, np.dtype[Any]]]:
    """The columns of a message type: name -> (shape in words, dtype)."""
    return {f.name: (f.metadata["shape"], f.metadata["dtype"]) for f in fields(message_type) if "shape" in f.metadata}
