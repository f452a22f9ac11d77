"""The messages as the stages see them: frozen dataclasses with NumPy columns.

Field names, order and units are those of `fan.proto`, and a test compares the two. Codec and export take enums, shapes
and types from the declarations below, so that a new field needs an entry here and in `fan.proto`, and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TypeAlias, get_args

import numpy as np

from schemas.fields import Array, OpenEnum, column, derived, time_column
from schemas.tacho import Tacho

LARGEST_PERIOD_NS = 86_400_000_000_000  # a day
FURTHEST_T_NS = (1 << 62) - LARGEST_PERIOD_NS  # in the year 2116, and as far before 1970: differences fit into 64 bits
RECEIVE_TIMES = (1 - FURTHEST_T_NS, FURTHEST_T_NS - 1)
GRID_TIMES = (1 - (1 << 62), (1 << 62) - 1)  # the grid may go a little beyond what was received


class InvalidReason(OpenEnum):
    """Why a sample is not scored."""

    NONE = 0
    STALE = 1
    GAP = 2
    WARMING_UP = 3
    OUT_OF_RANGE = 4
    SATURATED = 5
    NO_SPEED = 6
    NO_TWIN = 7
    CLOCK_RESTARTED = 8
    STOPPED = 9
    STARTING = 10
    CONDITIONS_UNKNOWN = 11


class FanState(OpenEnum):
    """The state of a fan at one sample, as the scorer sees it."""

    UNKNOWN = 0
    NORMAL = 1
    SUSPECT = 2
    ALARM = 3
    RETURNING = 4
    COMMISSIONING = 5
    STOPPED = 6
    STARTING = 7


class Statistic(OpenEnum):
    """The statistics that are compared with limits; the values number them across messages and snapshots."""

    NONE = 0
    SPEED_SMOOTHED = 1
    SPEED_DRIFT = 2
    SPEED_VARIANCE_GROWTH = 3
    BALANCE_SMOOTHED = 4
    BALANCE_DRIFT = 5
    BALANCE_VARIANCE_GROWTH = 6
    SENSOR = 7
    STANDSTILL = 8


class Transition(OpenEnum):
    """What happened to an alarm, in the terms of OPC UA Part 9."""

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
    DATA_LOST = 17
    DATA_RESTORED = 18


class Action(OpenEnum):
    """What an operator can request."""

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


class Severity(OpenEnum):
    """Severity of an alarm."""

    NONE = 0
    WARNING = 1
    ALARM = 2


class StageStatus(OpenEnum):
    """Status that a stage reports of itself."""

    STARTING = 0
    OK = 1
    DEGRADED = 2
    STOPPED = 3


class TachoKind(OpenEnum):
    """How a speed is measured, as schemas.tacho explains."""

    INSTANTANEOUS = 0
    COUNT = 1
    PERIOD = 2
    AVERAGE = 3


@dataclass(frozen=True, slots=True)
class InputPosition:
    """How far a stage had read its main input for one tray when it made a message.

    Attributes:
        topic, producer, sequence: the input message consumed last.
        consumed_count: all input messages consumed so far, that one included.
        contiguous_from: no sequence number is missing from this one up to `sequence`.
        from_timer: the message was made later, by a timer or at the end of the stage, not on consuming the input.
    """

    topic: str
    producer: str
    sequence: int
    consumed_count: int
    contiguous_from: int
    from_timer: bool = False

    @classmethod
    def after(cls, before: InputPosition | None, topic: str, header: Header) -> InputPosition:
        """The position after one more message, the one with this header."""
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
    """Producer and sequence number of a message, its tray, and the input it was made from."""

    producer: str = ""
    sequence: int = 0
    tray: str = ""
    input_position: InputPosition | None = None


@dataclass(frozen=True, slots=True)
class StatedTacho:
    """What a speed is, as a source states it. It is not checked: `tacho` does that."""

    kind: TachoKind
    pulses: int = 0
    window_s: float = 0.0
    update_s: float = 0.0
    delay_s: float = 0.0
    step_rad_s: float = 0.0

    @classmethod
    def of(cls, tacho: Tacho) -> StatedTacho:
        """As it travels."""
        values = tacho.model_dump()
        return cls(TachoKind[values.pop("kind").upper()], **values)

    @property
    def tacho(self) -> Tacho:
        """As the measurement model takes it. Raises ValueError where these values are no tacho of this version."""
        names = (each.name for each in fields(self) if each.name != "kind")
        return Tacho.model_validate({"kind": self.kind.words, **{name: getattr(self, name) for name in names}})


@dataclass(frozen=True, eq=False, kw_only=True)
class Raw:
    """Samples as the device sent them. A column that the device does not have is empty.

    tachos: what the speeds are, one for all fans or one for each; empty where the source does not state it.
    """

    header: Header = Header()
    fans: int
    host_receive_t_ns: Array = column("samples", np.int64, limits=RECEIVE_TIMES)
    device_clock_us: Array = column("samples", np.uint32, optional=True)
    device_sequence: Array = column("samples", np.uint32, optional=True)
    command: Array = column("samples x fans", np.float64)
    speed_rad_s: Array = column("samples x fans", np.float64)
    supply_voltage_v: Array = column("samples x fans", np.float32, optional=True)
    current_a: Array = column("samples x fans", np.float32, optional=True)
    temperature_c: Array = column("samples x fans", np.float32, optional=True)
    tachos: tuple[StatedTacho, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class PushedSamples:
    """Samples of one tray that a client pushes, not yet checked.

    Attributes:
        t_ns: time of each sample by the clock of the client.
        first_number: of the first sample; the client counts its samples from 0, without gaps.
        newest_t_ns: of the newest sample the client had when it sent these: how much older than that a sample is says
            how long the client has kept it.
    """

    header: Header = Header()
    fans: int
    t_ns: Array = column("samples", np.int64, limits=RECEIVE_TIMES)
    first_number: int = 0
    newest_t_ns: int = 0
    command: Array = column("samples x fans", np.float64)
    speed_rad_s: Array = column("samples x fans", np.float64)
    supply_voltage_v: Array = column("samples x fans", np.float32, optional=True)
    current_a: Array = column("samples x fans", np.float32, optional=True)
    temperature_c: Array = column("samples x fans", np.float32, optional=True)


@dataclass(frozen=True, eq=False, kw_only=True)
class Grid:
    """Samples on a uniform time grid: command held, speed interpolated."""

    header: Header = Header()
    fans: int
    period_ns: int
    t_ns: Array = column("samples", np.int64, limits=GRID_TIMES)
    command: Array = column("samples x fans", np.float64)
    speed_rad_s: Array = column("samples x fans", np.float64)
    valid: Array = column("samples x fans", np.bool_)
    invalid_reason: Array = column("samples x fans", InvalidReason)
    reading_missing: Array = column("samples x fans", np.bool_, optional=True)
    """whether the newest raw sample at that time has no reading, though the speed may be known from those around it"""
    supply_voltage_v: Array = column("samples x fans", np.float32, optional=True)
    current_a: Array = column("samples x fans", np.float32, optional=True)
    temperature_c: Array = column("samples x fans", np.float32, optional=True)


@dataclass(frozen=True, eq=False, kw_only=True)
class Prediction:
    """The free run of the healthy twin beside the measurement."""

    header: Header = Header()
    fans: int
    period_ns: int
    t_ns: Array = column("samples", np.int64, limits=GRID_TIMES)
    command: Array = column("samples x fans", np.float64)
    measured_speed_rad_s: Array = column("samples x fans", np.float64)
    predicted_speed_rad_s: Array = column("samples x fans", np.float64)
    sigma_rad_s: Array = column("fans", np.float64)
    valid: Array = column("samples x fans", np.bool_)
    invalid_reason: Array = column("samples x fans", InvalidReason)
    twin: str = ""
    torque_balance_command: Array = column("samples x fans", np.float64, added_later=True)
    torque_balance_sigma_command: Array = column("fans", np.float64, added_later=True)
    reading_range_rad_s: Array = column("samples x fans", np.float64, optional=True)
    averaged_command: Array = column("samples x fans", np.float64, optional=True)
    reading_missing: Array = column("samples x fans", np.bool_, optional=True)
    """as in Grid"""
    air_density_ratio: Array = column("samples x fans", np.float64, optional=True)
    """of a twin that needs the temperature: relative to its reference. Its balance is that of speeds times this"""
    supply_voltage_v: Array = column("samples x fans", np.float32, optional=True)
    current_a: Array = column("samples x fans", np.float32, optional=True)
    temperature_c: Array = column("samples x fans", np.float32, optional=True)


@dataclass(frozen=True, eq=False, kw_only=True)
class Score:
    """Scored samples, with everything a viewer needs to draw them.

    No alarm is decided by these numbers, so they travel with seven digits.
    """

    header: Header = Header()
    fans: int
    period_ns: int
    t_ns: Array = column("samples", np.int64, limits=GRID_TIMES)
    command: Array = column("samples x fans", np.float32)
    measured_speed_rad_s: Array = column("samples x fans", np.float32)
    predicted_speed_rad_s: Array = column("samples x fans", np.float32)
    band_variance: Array = column("samples x fans", np.float32)
    """the square of half the width of the band"""
    smoothed_residual_rad_s: Array = column("samples x fans", np.float32)
    state: Array = column("samples x fans", FanState)
    valid: Array = column("samples x fans", np.bool_)
    invalid_reason: Array = column("samples x fans", InvalidReason)
    torque_balance_command: Array = column("samples x fans", np.float32, added_later=True)
    speed_baseline_rad_s: Array = column("samples x fans", np.float32, added_later=True)
    balance_baseline_command: Array = column("samples x fans", np.float32, added_later=True)
    score: Array = column("samples x fans", np.float32, added_later=True)
    statistic: Array = column("samples x fans", Statistic, added_later=True)
    supply_voltage_v: Array = column("samples x fans", np.float32, optional=True)
    current_a: Array = column("samples x fans", np.float32, optional=True)
    temperature_c: Array = column("samples x fans", np.float32, optional=True)

    @derived(np.float32)
    def residual_rad_s(self) -> Array:
        """Measured minus predicted."""
        return self.measured_speed_rad_s - self.predicted_speed_rad_s

    @derived(np.float32)
    def lower_bound_rad_s(self) -> Array:
        """Of the band."""
        return self.predicted_speed_rad_s - np.sqrt(self.band_variance)

    @derived(np.float32)
    def upper_bound_rad_s(self) -> Array:
        """Of the band."""
        return self.predicted_speed_rad_s + np.sqrt(self.band_variance)

    @derived(np.bool_)
    def outside(self) -> Array:
        """Whether the sample lies outside the band."""
        return np.abs(self.residual_rad_s) > np.sqrt(self.band_variance)


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """One possible cause of an alarm, with its evidence."""

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
    """A transition of a fan's alarm, and the state after it. Tray, fan and `onset_t_ns` identify the alarm."""

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
    stale: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class Request:
    """An operator's request about the alarms of a tray; fan -1 means all fans."""

    header: Header = Header()
    t_ns: int
    action: Action
    fan: int = -1
    duration_s: float = 0.0
    operator_name: str = ""
    comment: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScorerSnapshot:
    """State that a scorer needs to continue after a restart."""

    header: Header = Header()
    t_ns: int
    twin_sha256: str
    restored: bool = False
    state_json: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class Command:
    """Commands or set-points for the fans, from an operator or a controller; NaN leaves a fan unchanged."""

    header: Header = Header()
    fans: int
    t_ns: int
    command: Array = column("fans", np.float64, optional=True)
    set_point_rad_s: Array = column("fans", np.float64, optional=True)


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelCard:
    """The twin in force.

    content: the ONNX file of a learned twin, in force from the sample at t_ns on; empty: it is the file that the
    configuration names.
    """

    header: Header = Header()
    t_ns: int
    twin: str
    kind: str
    sha256: str
    sigma_rad_s: Array = column("fans", np.float64, optional=True)
    card_json: str = ""
    content: bytes = b""


@dataclass(frozen=True, eq=False, kw_only=True)
class NewTwin:
    """A learned twin that is to take over.

    content: its ONNX file. first_sample_t_ns: it takes over at the first sample that is not older; 0: with the next
    block, as a twin that has just been learned.
    """

    header: Header = Header()
    t_ns: int
    twin: str
    sha256: str
    content: bytes
    first_sample_t_ns: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Consumed:
    """What a session of a stage had consumed when it made an output: the input position of the header is the output's.

    Attributes:
        topic, output_sequence: of the output.
        first_t_ns, t_ns: its first and its newest sample.
    """

    header: Header = Header()
    topic: str
    output_sequence: int
    first_t_ns: int
    t_ns: int


@dataclass(frozen=True, eq=False, kw_only=True)
class Clock:
    """Position of a replay in the recording's own time; `rate` is 0 while it is paused."""

    header: Header = Header()
    t_ns: int
    rate: float


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
        refused: those of the received ones that were ignored, because another process owns the stage of their producer.
        unsaved: the last of the received ones, so many, that are lost if the stage is killed now.
    """

    key: str
    producer: str
    received: int
    missing: int
    duplicated: int
    next_sequence: int
    missing_at_start: int = 0
    refused: int = 0
    unsaved: int = 0


@dataclass(frozen=True, kw_only=True)
class Output:
    """One output of a stage; `published` is also the next sequence number."""

    key: str
    published: int


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
class AcceptedSamples:
    """What an acquisition accepts of the clients that push samples of a tray; commands in the tray's unit."""

    tray: str
    fans: int
    command_min: float
    command_max: float
    speed_max_rad_s: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Health:
    """Status of a process of a stage, and what it has received, sent and lost.

    Attributes:
        trays: those that it has, separated by commas; empty: all of the site. Earlier versions do not say it: there, a
            stage with a process for each tray has the one that its instance names.
        is_last: of its session, whatever its status. Earlier versions do not say it: see `has_ended`.
        has_unprocessed: input has arrived of which outputs may still be made, so `outputs` do not show that none came.
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
    has_unprocessed: bool = False

    @property
    def has_ended(self) -> bool:
        """Whether its session has ended, in order or with an error, and sends no more."""
        return self.is_last or self.status == StageStatus.STOPPED


Message: TypeAlias = (
    Raw
    | PushedSamples
    | Grid
    | Prediction
    | Score
    | Alarm
    | Request
    | ScorerSnapshot
    | Command
    | ModelCard
    | NewTwin
    | Consumed
    | Clock
    | Health
)
MESSAGE_TYPES: tuple[type[Message], ...] = get_args(Message)


def newest_t_ns(message: Message) -> int:
    """Time of a message's newest sample, or of the event it is about, ns since the epoch; 0 if it has no samples."""
    times = getattr(message, time_column(type(message)))
    if isinstance(times, int):
        return times
    return int(times[-1]) if len(times) else 0
