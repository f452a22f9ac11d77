"""The messages as the stages see them: frozen dataclasses with NumPy columns.

Field names, order and units are those of `fan.proto`, and a test compares the two. Codec and export take enums, shapes
and types from the declarations below, so that a new field needs an entry here and in `fan.proto`, and nothing else.
The header of all messages is in `header.py`, the health of a stage in `health.py`, enumerations are in `enums.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TypeAlias

import numpy as np

from fantwin.schemas.channels import Measured
from fantwin.schemas.enums import Action, FanState, Feedback, InvalidReason, Severity, Statistic, TachoKind, Transition
from fantwin.schemas.fan_names import fan_label
from fantwin.schemas.fields import Array, column, derived, time_column
from fantwin.schemas.formats import SNAPSHOT
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health
from fantwin.schemas.tacho import Tacho

LARGEST_PERIOD_NS = 86_400_000_000_000  # a day
FURTHEST_T_NS = (1 << 62) - LARGEST_PERIOD_NS  # in the year 2116, and as far before 1970: differences fit into 64 bits
RECEIVE_TIMES = (1 - FURTHEST_T_NS, FURTHEST_T_NS - 1)
OVERVIEW_ROW_NS = 1_000_000_000
GRID_TIMES = (1 - (1 << 62), (1 << 62) - 1)  # the grid may go a little beyond what was received


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
class Raw(Measured):
    """Accepted samples of the source, in rad/s, at their own times. A column that the device does not have is empty.

    tachos: what the speeds are, one for all fans or one for each; empty where the source does not state it.
    """

    header: Header = Header()
    fans: int
    host_receive_t_ns: Array = column("samples", np.int64, limits=RECEIVE_TIMES)
    device_clock_us: Array = column("samples", np.uint32, optional=True)
    device_sequence: Array = column("samples", np.uint32, optional=True)
    command: Array = column("samples x fans", np.float64)
    speed_rad_s: Array = column("samples x fans", np.float64)
    tachos: tuple[StatedTacho, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class PushedSamples(Measured):
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


@dataclass(frozen=True, eq=False, kw_only=True)
class Grid(Measured):
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
    reading_repeated: Array = column("samples x fans", np.bool_, optional=True)
    """whether a tacho that holds its reading shows that of the grid sample before, as no raw sample has come since"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Prediction(Measured):
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
    torque_balance_command: Array = column("samples x fans", np.float64)
    torque_balance_sigma_command: Array = column("fans", np.float64)
    reading_range_rad_s: Array = column("samples x fans", np.float64, optional=True)
    averaged_command: Array = column("samples x fans", np.float64, optional=True)
    reading_missing: Array = column("samples x fans", np.bool_, optional=True)
    """as in Grid"""
    air_density_ratio: Array = column("samples x fans", np.float64, optional=True)
    """of a twin that needs the temperature: relative to its reference. Its balance is that of speeds times this"""
    reading_repeated: Array = column("samples x fans", np.bool_, optional=True)
    """as in Grid"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Score(Measured):
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
    state: Array = column("samples x fans", FanState)
    valid: Array = column("samples x fans", np.bool_)
    invalid_reason: Array = column("samples x fans", InvalidReason)
    torque_balance_command: Array = column("samples x fans", np.float32)
    expected_residual_rad_s: Array = column("samples x fans", np.float32)
    expected_balance_command: Array = column("samples x fans", np.float32)
    score: Array = column("samples x fans", np.float32)
    statistic: Array = column("samples x fans", Statistic)

    @derived(np.float32)
    def residual_rad_s(self) -> Array:
        """Measured minus predicted."""
        return self.measured_speed_rad_s - self.predicted_speed_rad_s

    @derived(np.float32)
    def deviation_rad_s(self) -> Array:
        """What the residual has more than is expected of this fan when it is healthy."""
        return self.residual_rad_s - self.expected_residual_rad_s

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


@dataclass(frozen=True, eq=False, kw_only=True)
class Overview:
    """What the scores of each second come to. A row is of one second, or of one sample where these are rarer.

    Values are of the samples that were judged, NaN where none was. A scorer that takes a snapshot in the middle of a
    second sends the row so far, and at the end of the second the whole one.
    """

    header: Header = Header()
    fans: int
    t_ns: Array = column("samples", np.int64, limits=GRID_TIMES)
    """of the newest sample of each row"""
    predicted_speed_rad_s: Array = column("samples x fans", np.float32)
    band_half_width_rad_s: Array = column("samples x fans", np.float32)
    residual_rad_s: Array = column("samples x fans", np.float32)
    """measured minus predicted: the mean"""
    lowest_residual_rad_s: Array = column("samples x fans", np.float32)
    highest_residual_rad_s: Array = column("samples x fans", np.float32)
    highest_score: Array = column("samples x fans", np.float32)


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """One possible cause of an alarm, with its evidence."""

    cause: str
    probability: float
    parameter: str = ""
    change: float = 0.0
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
    residual_std_rad_s: float
    message: str
    transition: Transition = Transition.NONE
    statistic: Statistic = Statistic.NONE
    score: float = 0.0
    torque_balance_command: float = 0.0
    torque_balance_std_command: float = 0.0
    acknowledged: bool = False
    shelved_until_t_ns: int = 0
    out_of_service: bool = False
    causes: tuple[Diagnosis, ...] = ()
    request: str = ""
    operator_name: str = ""
    comment: str = ""
    stale: bool = False
    feedback: Feedback = Feedback.NONE
    feedback_by: str = ""
    feedback_reason: str = ""
    marked_onset_t_ns: int = 0
    fan_name: str = ""

    @property
    def label(self) -> str:
        """The fan for people: `CPU (fan 0)`, or `fan 0` without a name."""
        return fan_label(self.fan, self.fan_name)

    @property
    def about(self) -> str:
        """The message without the fan, with which it begins."""
        return self.message.removeprefix(f"{self.label}: ")


@dataclass(frozen=True, eq=False, kw_only=True)
class Request:
    """An operator's request about the alarms of a tray; fan -1 means all fans.

    onset_t_ns: for feedback, of the alarm that is meant, to within a second; 0: the last one.
    """

    header: Header = Header()
    t_ns: int
    action: Action
    fan: int = -1
    duration_s: float = 0.0
    operator_name: str = ""
    comment: str = ""
    onset_t_ns: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class ScorerSnapshot:
    """State that a scorer needs to continue after a restart. format: number of `state_json`; 0: none."""

    header: Header = Header()
    t_ns: int
    twin_sha256: str
    restored: bool = False
    state_json: str = ""
    format: int = SNAPSHOT.written


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
        topic: topic of the output.
        first_t_ns, t_ns: times of its first and its newest sample.
    """

    header: Header = Header()
    topic: str
    first_t_ns: int
    t_ns: int


@dataclass(frozen=True, eq=False, kw_only=True)
class Clock:
    """Position of a replay in the recording's own time; `rate` is 0 while it is paused."""

    header: Header = Header()
    t_ns: int
    rate: float


Message: TypeAlias = (
    Raw
    | PushedSamples
    | Grid
    | Prediction
    | Score
    | Overview
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


def newest_t_ns(message: Message) -> int:
    """Time of a message's newest sample, or of the event it is about, ns since the epoch; 0 if it has no samples."""
    times = getattr(message, time_column(type(message)))
    if isinstance(times, int):
        return times
    return times.item(-1) if len(times) else 0
