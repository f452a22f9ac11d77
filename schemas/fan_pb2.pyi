from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class InvalidReason(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    INVALID_REASON_NONE: _ClassVar[InvalidReason]
    INVALID_REASON_STALE: _ClassVar[InvalidReason]
    INVALID_REASON_GAP: _ClassVar[InvalidReason]
    INVALID_REASON_WARMING_UP: _ClassVar[InvalidReason]
    INVALID_REASON_OUT_OF_RANGE: _ClassVar[InvalidReason]
    INVALID_REASON_NO_SPEED: _ClassVar[InvalidReason]
    INVALID_REASON_NO_TWIN: _ClassVar[InvalidReason]
    INVALID_REASON_CLOCK_RESTARTED: _ClassVar[InvalidReason]
    INVALID_REASON_STOPPED: _ClassVar[InvalidReason]
    INVALID_REASON_STARTING: _ClassVar[InvalidReason]
    INVALID_REASON_CONDITIONS_UNKNOWN: _ClassVar[InvalidReason]

class FanState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    FAN_STATE_UNKNOWN: _ClassVar[FanState]
    FAN_STATE_NORMAL: _ClassVar[FanState]
    FAN_STATE_SUSPECT: _ClassVar[FanState]
    FAN_STATE_ALARM: _ClassVar[FanState]
    FAN_STATE_RETURNING: _ClassVar[FanState]
    FAN_STATE_STOPPED: _ClassVar[FanState]
    FAN_STATE_STARTING: _ClassVar[FanState]

class Statistic(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    STATISTIC_NONE: _ClassVar[Statistic]
    STATISTIC_DEVIATION: _ClassVar[Statistic]
    STATISTIC_MISSING_READINGS: _ClassVar[Statistic]
    STATISTIC_STANDSTILL: _ClassVar[Statistic]
    STATISTIC_WEAR: _ClassVar[Statistic]

class Transition(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TRANSITION_NONE: _ClassVar[Transition]
    TRANSITION_RAISED: _ClassVar[Transition]
    TRANSITION_SEVERITY: _ClassVar[Transition]
    TRANSITION_DIAGNOSED: _ClassVar[Transition]
    TRANSITION_CLEARED: _ClassVar[Transition]
    TRANSITION_ACKNOWLEDGED: _ClassVar[Transition]
    TRANSITION_SHELVED: _ClassVar[Transition]
    TRANSITION_UNSHELVED: _ClassVar[Transition]
    TRANSITION_OUT_OF_SERVICE: _ClassVar[Transition]
    TRANSITION_IN_SERVICE: _ClassVar[Transition]
    TRANSITION_COMMISSIONING: _ClassVar[Transition]
    TRANSITION_REPUBLISHED: _ClassVar[Transition]
    TRANSITION_REFUSED: _ClassVar[Transition]
    TRANSITION_DATA_LOST: _ClassVar[Transition]
    TRANSITION_DATA_RESTORED: _ClassVar[Transition]
    TRANSITION_MARKED_TRUE: _ClassVar[Transition]
    TRANSITION_MARKED_FALSE: _ClassVar[Transition]
    TRANSITION_COMMENTED: _ClassVar[Transition]

class Action(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ACTION_NONE: _ClassVar[Action]
    ACTION_ACKNOWLEDGE: _ClassVar[Action]
    ACTION_SHELVE: _ClassVar[Action]
    ACTION_UNSHELVE: _ClassVar[Action]
    ACTION_OUT_OF_SERVICE: _ClassVar[Action]
    ACTION_IN_SERVICE: _ClassVar[Action]
    ACTION_COMMISSION: _ClassVar[Action]
    ACTION_TRUE_ALARM: _ClassVar[Action]
    ACTION_FALSE_ALARM: _ClassVar[Action]
    ACTION_COMMENT: _ClassVar[Action]
    ACTION_SWEEP: _ClassVar[Action]
    ACTION_STOP_SWEEP: _ClassVar[Action]

class Feedback(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    FEEDBACK_NONE: _ClassVar[Feedback]
    FEEDBACK_TRUE_ALARM: _ClassVar[Feedback]
    FEEDBACK_FALSE_ALARM: _ClassVar[Feedback]

class Severity(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SEVERITY_NONE: _ClassVar[Severity]
    SEVERITY_WARNING: _ClassVar[Severity]
    SEVERITY_ALARM: _ClassVar[Severity]

class TachoKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TACHO_KIND_INSTANTANEOUS: _ClassVar[TachoKind]
    TACHO_KIND_COUNT: _ClassVar[TachoKind]
    TACHO_KIND_PERIOD: _ClassVar[TachoKind]
    TACHO_KIND_AVERAGE: _ClassVar[TachoKind]

class StageStatus(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    STAGE_STATUS_STARTING: _ClassVar[StageStatus]
    STAGE_STATUS_OK: _ClassVar[StageStatus]
    STAGE_STATUS_DEGRADED: _ClassVar[StageStatus]
    STAGE_STATUS_STOPPED: _ClassVar[StageStatus]
INVALID_REASON_NONE: InvalidReason
INVALID_REASON_STALE: InvalidReason
INVALID_REASON_GAP: InvalidReason
INVALID_REASON_WARMING_UP: InvalidReason
INVALID_REASON_OUT_OF_RANGE: InvalidReason
INVALID_REASON_NO_SPEED: InvalidReason
INVALID_REASON_NO_TWIN: InvalidReason
INVALID_REASON_CLOCK_RESTARTED: InvalidReason
INVALID_REASON_STOPPED: InvalidReason
INVALID_REASON_STARTING: InvalidReason
INVALID_REASON_CONDITIONS_UNKNOWN: InvalidReason
FAN_STATE_UNKNOWN: FanState
FAN_STATE_NORMAL: FanState
FAN_STATE_SUSPECT: FanState
FAN_STATE_ALARM: FanState
FAN_STATE_RETURNING: FanState
FAN_STATE_STOPPED: FanState
FAN_STATE_STARTING: FanState
STATISTIC_NONE: Statistic
STATISTIC_DEVIATION: Statistic
STATISTIC_MISSING_READINGS: Statistic
STATISTIC_STANDSTILL: Statistic
STATISTIC_WEAR: Statistic
TRANSITION_NONE: Transition
TRANSITION_RAISED: Transition
TRANSITION_SEVERITY: Transition
TRANSITION_DIAGNOSED: Transition
TRANSITION_CLEARED: Transition
TRANSITION_ACKNOWLEDGED: Transition
TRANSITION_SHELVED: Transition
TRANSITION_UNSHELVED: Transition
TRANSITION_OUT_OF_SERVICE: Transition
TRANSITION_IN_SERVICE: Transition
TRANSITION_COMMISSIONING: Transition
TRANSITION_REPUBLISHED: Transition
TRANSITION_REFUSED: Transition
TRANSITION_DATA_LOST: Transition
TRANSITION_DATA_RESTORED: Transition
TRANSITION_MARKED_TRUE: Transition
TRANSITION_MARKED_FALSE: Transition
TRANSITION_COMMENTED: Transition
ACTION_NONE: Action
ACTION_ACKNOWLEDGE: Action
ACTION_SHELVE: Action
ACTION_UNSHELVE: Action
ACTION_OUT_OF_SERVICE: Action
ACTION_IN_SERVICE: Action
ACTION_COMMISSION: Action
ACTION_TRUE_ALARM: Action
ACTION_FALSE_ALARM: Action
ACTION_COMMENT: Action
ACTION_SWEEP: Action
ACTION_STOP_SWEEP: Action
FEEDBACK_NONE: Feedback
FEEDBACK_TRUE_ALARM: Feedback
FEEDBACK_FALSE_ALARM: Feedback
SEVERITY_NONE: Severity
SEVERITY_WARNING: Severity
SEVERITY_ALARM: Severity
TACHO_KIND_INSTANTANEOUS: TachoKind
TACHO_KIND_COUNT: TachoKind
TACHO_KIND_PERIOD: TachoKind
TACHO_KIND_AVERAGE: TachoKind
STAGE_STATUS_STARTING: StageStatus
STAGE_STATUS_OK: StageStatus
STAGE_STATUS_DEGRADED: StageStatus
STAGE_STATUS_STOPPED: StageStatus

class Header(_message.Message):
    __slots__ = ("producer", "sequence", "tray", "input_position")
    PRODUCER_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    TRAY_FIELD_NUMBER: _ClassVar[int]
    INPUT_POSITION_FIELD_NUMBER: _ClassVar[int]
    producer: str
    sequence: int
    tray: str
    input_position: InputPosition
    def __init__(self, producer: _Optional[str] = ..., sequence: _Optional[int] = ..., tray: _Optional[str] = ..., input_position: _Optional[_Union[InputPosition, _Mapping]] = ...) -> None: ...

class InputPosition(_message.Message):
    __slots__ = ("topic", "producer", "sequence", "consumed_count", "contiguous_from", "from_timer")
    TOPIC_FIELD_NUMBER: _ClassVar[int]
    PRODUCER_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    CONSUMED_COUNT_FIELD_NUMBER: _ClassVar[int]
    CONTIGUOUS_FROM_FIELD_NUMBER: _ClassVar[int]
    FROM_TIMER_FIELD_NUMBER: _ClassVar[int]
    topic: str
    producer: str
    sequence: int
    consumed_count: int
    contiguous_from: int
    from_timer: bool
    def __init__(self, topic: _Optional[str] = ..., producer: _Optional[str] = ..., sequence: _Optional[int] = ..., consumed_count: _Optional[int] = ..., contiguous_from: _Optional[int] = ..., from_timer: _Optional[bool] = ...) -> None: ...

class Measured(_message.Message):
    __slots__ = ("supply_voltage_v", "current_a", "temperature_c")
    SUPPLY_VOLTAGE_V_FIELD_NUMBER: _ClassVar[int]
    CURRENT_A_FIELD_NUMBER: _ClassVar[int]
    TEMPERATURE_C_FIELD_NUMBER: _ClassVar[int]
    supply_voltage_v: _containers.RepeatedScalarFieldContainer[float]
    current_a: _containers.RepeatedScalarFieldContainer[float]
    temperature_c: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, supply_voltage_v: _Optional[_Iterable[float]] = ..., current_a: _Optional[_Iterable[float]] = ..., temperature_c: _Optional[_Iterable[float]] = ...) -> None: ...

class Raw(_message.Message):
    __slots__ = ("header", "fans", "host_receive_t_ns", "device_clock_us", "device_sequence", "command", "speed_rad_s", "measured", "tachos")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    FANS_FIELD_NUMBER: _ClassVar[int]
    HOST_RECEIVE_T_NS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_CLOCK_US_FIELD_NUMBER: _ClassVar[int]
    DEVICE_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    COMMAND_FIELD_NUMBER: _ClassVar[int]
    SPEED_RAD_S_FIELD_NUMBER: _ClassVar[int]
    MEASURED_FIELD_NUMBER: _ClassVar[int]
    TACHOS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    fans: int
    host_receive_t_ns: _containers.RepeatedScalarFieldContainer[int]
    device_clock_us: _containers.RepeatedScalarFieldContainer[int]
    device_sequence: _containers.RepeatedScalarFieldContainer[int]
    command: _containers.RepeatedScalarFieldContainer[float]
    speed_rad_s: _containers.RepeatedScalarFieldContainer[float]
    measured: Measured
    tachos: _containers.RepeatedCompositeFieldContainer[StatedTacho]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., fans: _Optional[int] = ..., host_receive_t_ns: _Optional[_Iterable[int]] = ..., device_clock_us: _Optional[_Iterable[int]] = ..., device_sequence: _Optional[_Iterable[int]] = ..., command: _Optional[_Iterable[float]] = ..., speed_rad_s: _Optional[_Iterable[float]] = ..., measured: _Optional[_Union[Measured, _Mapping]] = ..., tachos: _Optional[_Iterable[_Union[StatedTacho, _Mapping]]] = ...) -> None: ...

class StatedTacho(_message.Message):
    __slots__ = ("kind", "pulses", "window_s", "update_s", "delay_s", "step_rad_s")
    KIND_FIELD_NUMBER: _ClassVar[int]
    PULSES_FIELD_NUMBER: _ClassVar[int]
    WINDOW_S_FIELD_NUMBER: _ClassVar[int]
    UPDATE_S_FIELD_NUMBER: _ClassVar[int]
    DELAY_S_FIELD_NUMBER: _ClassVar[int]
    STEP_RAD_S_FIELD_NUMBER: _ClassVar[int]
    kind: TachoKind
    pulses: int
    window_s: float
    update_s: float
    delay_s: float
    step_rad_s: float
    def __init__(self, kind: _Optional[_Union[TachoKind, str]] = ..., pulses: _Optional[int] = ..., window_s: _Optional[float] = ..., update_s: _Optional[float] = ..., delay_s: _Optional[float] = ..., step_rad_s: _Optional[float] = ...) -> None: ...

class PushedSamples(_message.Message):
    __slots__ = ("header", "fans", "t_ns", "first_number", "newest_t_ns", "command", "speed_rad_s", "measured")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    FANS_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    FIRST_NUMBER_FIELD_NUMBER: _ClassVar[int]
    NEWEST_T_NS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_FIELD_NUMBER: _ClassVar[int]
    SPEED_RAD_S_FIELD_NUMBER: _ClassVar[int]
    MEASURED_FIELD_NUMBER: _ClassVar[int]
    header: Header
    fans: int
    t_ns: _containers.RepeatedScalarFieldContainer[int]
    first_number: int
    newest_t_ns: int
    command: _containers.RepeatedScalarFieldContainer[float]
    speed_rad_s: _containers.RepeatedScalarFieldContainer[float]
    measured: Measured
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., fans: _Optional[int] = ..., t_ns: _Optional[_Iterable[int]] = ..., first_number: _Optional[int] = ..., newest_t_ns: _Optional[int] = ..., command: _Optional[_Iterable[float]] = ..., speed_rad_s: _Optional[_Iterable[float]] = ..., measured: _Optional[_Union[Measured, _Mapping]] = ...) -> None: ...

class Grid(_message.Message):
    __slots__ = ("header", "fans", "period_ns", "t_ns", "command", "speed_rad_s", "valid", "invalid_reason", "reading_missing", "measured", "reading_repeated")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    FANS_FIELD_NUMBER: _ClassVar[int]
    PERIOD_NS_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_FIELD_NUMBER: _ClassVar[int]
    SPEED_RAD_S_FIELD_NUMBER: _ClassVar[int]
    VALID_FIELD_NUMBER: _ClassVar[int]
    INVALID_REASON_FIELD_NUMBER: _ClassVar[int]
    READING_MISSING_FIELD_NUMBER: _ClassVar[int]
    MEASURED_FIELD_NUMBER: _ClassVar[int]
    READING_REPEATED_FIELD_NUMBER: _ClassVar[int]
    header: Header
    fans: int
    period_ns: int
    t_ns: _containers.RepeatedScalarFieldContainer[int]
    command: _containers.RepeatedScalarFieldContainer[float]
    speed_rad_s: _containers.RepeatedScalarFieldContainer[float]
    valid: _containers.RepeatedScalarFieldContainer[bool]
    invalid_reason: _containers.RepeatedScalarFieldContainer[InvalidReason]
    reading_missing: _containers.RepeatedScalarFieldContainer[bool]
    measured: Measured
    reading_repeated: _containers.RepeatedScalarFieldContainer[bool]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., fans: _Optional[int] = ..., period_ns: _Optional[int] = ..., t_ns: _Optional[_Iterable[int]] = ..., command: _Optional[_Iterable[float]] = ..., speed_rad_s: _Optional[_Iterable[float]] = ..., valid: _Optional[_Iterable[bool]] = ..., invalid_reason: _Optional[_Iterable[_Union[InvalidReason, str]]] = ..., reading_missing: _Optional[_Iterable[bool]] = ..., measured: _Optional[_Union[Measured, _Mapping]] = ..., reading_repeated: _Optional[_Iterable[bool]] = ...) -> None: ...

class Prediction(_message.Message):
    __slots__ = ("header", "fans", "period_ns", "t_ns", "command", "measured_speed_rad_s", "predicted_speed_rad_s", "sigma_rad_s", "valid", "invalid_reason", "twin", "torque_balance_command", "torque_balance_sigma_command", "reading_range_rad_s", "averaged_command", "reading_missing", "air_density_ratio", "measured", "reading_repeated")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    FANS_FIELD_NUMBER: _ClassVar[int]
    PERIOD_NS_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_FIELD_NUMBER: _ClassVar[int]
    MEASURED_SPEED_RAD_S_FIELD_NUMBER: _ClassVar[int]
    PREDICTED_SPEED_RAD_S_FIELD_NUMBER: _ClassVar[int]
    SIGMA_RAD_S_FIELD_NUMBER: _ClassVar[int]
    VALID_FIELD_NUMBER: _ClassVar[int]
    INVALID_REASON_FIELD_NUMBER: _ClassVar[int]
    TWIN_FIELD_NUMBER: _ClassVar[int]
    TORQUE_BALANCE_COMMAND_FIELD_NUMBER: _ClassVar[int]
    TORQUE_BALANCE_SIGMA_COMMAND_FIELD_NUMBER: _ClassVar[int]
    READING_RANGE_RAD_S_FIELD_NUMBER: _ClassVar[int]
    AVERAGED_COMMAND_FIELD_NUMBER: _ClassVar[int]
    READING_MISSING_FIELD_NUMBER: _ClassVar[int]
    AIR_DENSITY_RATIO_FIELD_NUMBER: _ClassVar[int]
    MEASURED_FIELD_NUMBER: _ClassVar[int]
    READING_REPEATED_FIELD_NUMBER: _ClassVar[int]
    header: Header
    fans: int
    period_ns: int
    t_ns: _containers.RepeatedScalarFieldContainer[int]
    command: _containers.RepeatedScalarFieldContainer[float]
    measured_speed_rad_s: _containers.RepeatedScalarFieldContainer[float]
    predicted_speed_rad_s: _containers.RepeatedScalarFieldContainer[float]
    sigma_rad_s: _containers.RepeatedScalarFieldContainer[float]
    valid: _containers.RepeatedScalarFieldContainer[bool]
    invalid_reason: _containers.RepeatedScalarFieldContainer[InvalidReason]
    twin: str
    torque_balance_command: _containers.RepeatedScalarFieldContainer[float]
    torque_balance_sigma_command: _containers.RepeatedScalarFieldContainer[float]
    reading_range_rad_s: _containers.RepeatedScalarFieldContainer[float]
    averaged_command: _containers.RepeatedScalarFieldContainer[float]
    reading_missing: _containers.RepeatedScalarFieldContainer[bool]
    air_density_ratio: _containers.RepeatedScalarFieldContainer[float]
    measured: Measured
    reading_repeated: _containers.RepeatedScalarFieldContainer[bool]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., fans: _Optional[int] = ..., period_ns: _Optional[int] = ..., t_ns: _Optional[_Iterable[int]] = ..., command: _Optional[_Iterable[float]] = ..., measured_speed_rad_s: _Optional[_Iterable[float]] = ..., predicted_speed_rad_s: _Optional[_Iterable[float]] = ..., sigma_rad_s: _Optional[_Iterable[float]] = ..., valid: _Optional[_Iterable[bool]] = ..., invalid_reason: _Optional[_Iterable[_Union[InvalidReason, str]]] = ..., twin: _Optional[str] = ..., torque_balance_command: _Optional[_Iterable[float]] = ..., torque_balance_sigma_command: _Optional[_Iterable[float]] = ..., reading_range_rad_s: _Optional[_Iterable[float]] = ..., averaged_command: _Optional[_Iterable[float]] = ..., reading_missing: _Optional[_Iterable[bool]] = ..., air_density_ratio: _Optional[_Iterable[float]] = ..., measured: _Optional[_Union[Measured, _Mapping]] = ..., reading_repeated: _Optional[_Iterable[bool]] = ...) -> None: ...

class Score(_message.Message):
    __slots__ = ("header", "fans", "period_ns", "t_ns", "command", "measured_speed_rad_s", "predicted_speed_rad_s", "band_variance", "state", "valid", "invalid_reason", "torque_balance_command", "expected_residual_rad_s", "expected_balance_command", "score", "statistic", "measured")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    FANS_FIELD_NUMBER: _ClassVar[int]
    PERIOD_NS_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_FIELD_NUMBER: _ClassVar[int]
    MEASURED_SPEED_RAD_S_FIELD_NUMBER: _ClassVar[int]
    PREDICTED_SPEED_RAD_S_FIELD_NUMBER: _ClassVar[int]
    BAND_VARIANCE_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    VALID_FIELD_NUMBER: _ClassVar[int]
    INVALID_REASON_FIELD_NUMBER: _ClassVar[int]
    TORQUE_BALANCE_COMMAND_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_RESIDUAL_RAD_S_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_BALANCE_COMMAND_FIELD_NUMBER: _ClassVar[int]
    SCORE_FIELD_NUMBER: _ClassVar[int]
    STATISTIC_FIELD_NUMBER: _ClassVar[int]
    MEASURED_FIELD_NUMBER: _ClassVar[int]
    header: Header
    fans: int
    period_ns: int
    t_ns: _containers.RepeatedScalarFieldContainer[int]
    command: _containers.RepeatedScalarFieldContainer[float]
    measured_speed_rad_s: _containers.RepeatedScalarFieldContainer[float]
    predicted_speed_rad_s: _containers.RepeatedScalarFieldContainer[float]
    band_variance: _containers.RepeatedScalarFieldContainer[float]
    state: _containers.RepeatedScalarFieldContainer[FanState]
    valid: _containers.RepeatedScalarFieldContainer[bool]
    invalid_reason: _containers.RepeatedScalarFieldContainer[InvalidReason]
    torque_balance_command: _containers.RepeatedScalarFieldContainer[float]
    expected_residual_rad_s: _containers.RepeatedScalarFieldContainer[float]
    expected_balance_command: _containers.RepeatedScalarFieldContainer[float]
    score: _containers.RepeatedScalarFieldContainer[float]
    statistic: _containers.RepeatedScalarFieldContainer[Statistic]
    measured: Measured
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., fans: _Optional[int] = ..., period_ns: _Optional[int] = ..., t_ns: _Optional[_Iterable[int]] = ..., command: _Optional[_Iterable[float]] = ..., measured_speed_rad_s: _Optional[_Iterable[float]] = ..., predicted_speed_rad_s: _Optional[_Iterable[float]] = ..., band_variance: _Optional[_Iterable[float]] = ..., state: _Optional[_Iterable[_Union[FanState, str]]] = ..., valid: _Optional[_Iterable[bool]] = ..., invalid_reason: _Optional[_Iterable[_Union[InvalidReason, str]]] = ..., torque_balance_command: _Optional[_Iterable[float]] = ..., expected_residual_rad_s: _Optional[_Iterable[float]] = ..., expected_balance_command: _Optional[_Iterable[float]] = ..., score: _Optional[_Iterable[float]] = ..., statistic: _Optional[_Iterable[_Union[Statistic, str]]] = ..., measured: _Optional[_Union[Measured, _Mapping]] = ...) -> None: ...

class Overview(_message.Message):
    __slots__ = ("header", "fans", "t_ns", "predicted_speed_rad_s", "band_half_width_rad_s", "residual_rad_s", "lowest_residual_rad_s", "highest_residual_rad_s", "highest_score")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    FANS_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    PREDICTED_SPEED_RAD_S_FIELD_NUMBER: _ClassVar[int]
    BAND_HALF_WIDTH_RAD_S_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_RAD_S_FIELD_NUMBER: _ClassVar[int]
    LOWEST_RESIDUAL_RAD_S_FIELD_NUMBER: _ClassVar[int]
    HIGHEST_RESIDUAL_RAD_S_FIELD_NUMBER: _ClassVar[int]
    HIGHEST_SCORE_FIELD_NUMBER: _ClassVar[int]
    header: Header
    fans: int
    t_ns: _containers.RepeatedScalarFieldContainer[int]
    predicted_speed_rad_s: _containers.RepeatedScalarFieldContainer[float]
    band_half_width_rad_s: _containers.RepeatedScalarFieldContainer[float]
    residual_rad_s: _containers.RepeatedScalarFieldContainer[float]
    lowest_residual_rad_s: _containers.RepeatedScalarFieldContainer[float]
    highest_residual_rad_s: _containers.RepeatedScalarFieldContainer[float]
    highest_score: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., fans: _Optional[int] = ..., t_ns: _Optional[_Iterable[int]] = ..., predicted_speed_rad_s: _Optional[_Iterable[float]] = ..., band_half_width_rad_s: _Optional[_Iterable[float]] = ..., residual_rad_s: _Optional[_Iterable[float]] = ..., lowest_residual_rad_s: _Optional[_Iterable[float]] = ..., highest_residual_rad_s: _Optional[_Iterable[float]] = ..., highest_score: _Optional[_Iterable[float]] = ...) -> None: ...

class Diagnosis(_message.Message):
    __slots__ = ("cause", "probability", "parameter", "change", "unit", "evidence")
    CAUSE_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    PARAMETER_FIELD_NUMBER: _ClassVar[int]
    CHANGE_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    EVIDENCE_FIELD_NUMBER: _ClassVar[int]
    cause: str
    probability: float
    parameter: str
    change: float
    unit: str
    evidence: str
    def __init__(self, cause: _Optional[str] = ..., probability: _Optional[float] = ..., parameter: _Optional[str] = ..., change: _Optional[float] = ..., unit: _Optional[str] = ..., evidence: _Optional[str] = ...) -> None: ...

class Alarm(_message.Message):
    __slots__ = ("header", "fan", "active", "severity", "t_ns", "onset_t_ns", "residual_rad_s", "residual_std_rad_s", "message", "transition", "statistic", "score", "torque_balance_command", "torque_balance_std_command", "acknowledged", "shelved_until_t_ns", "out_of_service", "causes", "request", "operator_name", "comment", "stale", "feedback", "feedback_by", "feedback_reason", "marked_onset_t_ns", "fan_name")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    FAN_FIELD_NUMBER: _ClassVar[int]
    ACTIVE_FIELD_NUMBER: _ClassVar[int]
    SEVERITY_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    ONSET_T_NS_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_RAD_S_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_STD_RAD_S_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    TRANSITION_FIELD_NUMBER: _ClassVar[int]
    STATISTIC_FIELD_NUMBER: _ClassVar[int]
    SCORE_FIELD_NUMBER: _ClassVar[int]
    TORQUE_BALANCE_COMMAND_FIELD_NUMBER: _ClassVar[int]
    TORQUE_BALANCE_STD_COMMAND_FIELD_NUMBER: _ClassVar[int]
    ACKNOWLEDGED_FIELD_NUMBER: _ClassVar[int]
    SHELVED_UNTIL_T_NS_FIELD_NUMBER: _ClassVar[int]
    OUT_OF_SERVICE_FIELD_NUMBER: _ClassVar[int]
    CAUSES_FIELD_NUMBER: _ClassVar[int]
    REQUEST_FIELD_NUMBER: _ClassVar[int]
    OPERATOR_NAME_FIELD_NUMBER: _ClassVar[int]
    COMMENT_FIELD_NUMBER: _ClassVar[int]
    STALE_FIELD_NUMBER: _ClassVar[int]
    FEEDBACK_FIELD_NUMBER: _ClassVar[int]
    FEEDBACK_BY_FIELD_NUMBER: _ClassVar[int]
    FEEDBACK_REASON_FIELD_NUMBER: _ClassVar[int]
    MARKED_ONSET_T_NS_FIELD_NUMBER: _ClassVar[int]
    FAN_NAME_FIELD_NUMBER: _ClassVar[int]
    header: Header
    fan: int
    active: bool
    severity: Severity
    t_ns: int
    onset_t_ns: int
    residual_rad_s: float
    residual_std_rad_s: float
    message: str
    transition: Transition
    statistic: Statistic
    score: float
    torque_balance_command: float
    torque_balance_std_command: float
    acknowledged: bool
    shelved_until_t_ns: int
    out_of_service: bool
    causes: _containers.RepeatedCompositeFieldContainer[Diagnosis]
    request: str
    operator_name: str
    comment: str
    stale: bool
    feedback: Feedback
    feedback_by: str
    feedback_reason: str
    marked_onset_t_ns: int
    fan_name: str
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., fan: _Optional[int] = ..., active: _Optional[bool] = ..., severity: _Optional[_Union[Severity, str]] = ..., t_ns: _Optional[int] = ..., onset_t_ns: _Optional[int] = ..., residual_rad_s: _Optional[float] = ..., residual_std_rad_s: _Optional[float] = ..., message: _Optional[str] = ..., transition: _Optional[_Union[Transition, str]] = ..., statistic: _Optional[_Union[Statistic, str]] = ..., score: _Optional[float] = ..., torque_balance_command: _Optional[float] = ..., torque_balance_std_command: _Optional[float] = ..., acknowledged: _Optional[bool] = ..., shelved_until_t_ns: _Optional[int] = ..., out_of_service: _Optional[bool] = ..., causes: _Optional[_Iterable[_Union[Diagnosis, _Mapping]]] = ..., request: _Optional[str] = ..., operator_name: _Optional[str] = ..., comment: _Optional[str] = ..., stale: _Optional[bool] = ..., feedback: _Optional[_Union[Feedback, str]] = ..., feedback_by: _Optional[str] = ..., feedback_reason: _Optional[str] = ..., marked_onset_t_ns: _Optional[int] = ..., fan_name: _Optional[str] = ...) -> None: ...

class Request(_message.Message):
    __slots__ = ("header", "t_ns", "action", "fan", "duration_s", "operator_name", "comment", "onset_t_ns")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    ACTION_FIELD_NUMBER: _ClassVar[int]
    FAN_FIELD_NUMBER: _ClassVar[int]
    DURATION_S_FIELD_NUMBER: _ClassVar[int]
    OPERATOR_NAME_FIELD_NUMBER: _ClassVar[int]
    COMMENT_FIELD_NUMBER: _ClassVar[int]
    ONSET_T_NS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    t_ns: int
    action: Action
    fan: int
    duration_s: float
    operator_name: str
    comment: str
    onset_t_ns: int
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., t_ns: _Optional[int] = ..., action: _Optional[_Union[Action, str]] = ..., fan: _Optional[int] = ..., duration_s: _Optional[float] = ..., operator_name: _Optional[str] = ..., comment: _Optional[str] = ..., onset_t_ns: _Optional[int] = ...) -> None: ...

class ScorerSnapshot(_message.Message):
    __slots__ = ("header", "t_ns", "twin_sha256", "restored", "state_json", "format")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    TWIN_SHA256_FIELD_NUMBER: _ClassVar[int]
    RESTORED_FIELD_NUMBER: _ClassVar[int]
    STATE_JSON_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    header: Header
    t_ns: int
    twin_sha256: str
    restored: bool
    state_json: str
    format: int
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., t_ns: _Optional[int] = ..., twin_sha256: _Optional[str] = ..., restored: _Optional[bool] = ..., state_json: _Optional[str] = ..., format: _Optional[int] = ...) -> None: ...

class Command(_message.Message):
    __slots__ = ("header", "fans", "t_ns", "command", "set_point_rad_s")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    FANS_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_FIELD_NUMBER: _ClassVar[int]
    SET_POINT_RAD_S_FIELD_NUMBER: _ClassVar[int]
    header: Header
    fans: int
    t_ns: int
    command: _containers.RepeatedScalarFieldContainer[float]
    set_point_rad_s: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., fans: _Optional[int] = ..., t_ns: _Optional[int] = ..., command: _Optional[_Iterable[float]] = ..., set_point_rad_s: _Optional[_Iterable[float]] = ...) -> None: ...

class ModelCard(_message.Message):
    __slots__ = ("header", "t_ns", "twin", "kind", "sha256", "sigma_rad_s", "card_json", "content")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    TWIN_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    SIGMA_RAD_S_FIELD_NUMBER: _ClassVar[int]
    CARD_JSON_FIELD_NUMBER: _ClassVar[int]
    CONTENT_FIELD_NUMBER: _ClassVar[int]
    header: Header
    t_ns: int
    twin: str
    kind: str
    sha256: str
    sigma_rad_s: _containers.RepeatedScalarFieldContainer[float]
    card_json: str
    content: bytes
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., t_ns: _Optional[int] = ..., twin: _Optional[str] = ..., kind: _Optional[str] = ..., sha256: _Optional[str] = ..., sigma_rad_s: _Optional[_Iterable[float]] = ..., card_json: _Optional[str] = ..., content: _Optional[bytes] = ...) -> None: ...

class NewTwin(_message.Message):
    __slots__ = ("header", "t_ns", "twin", "sha256", "content", "first_sample_t_ns")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    TWIN_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    CONTENT_FIELD_NUMBER: _ClassVar[int]
    FIRST_SAMPLE_T_NS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    t_ns: int
    twin: str
    sha256: str
    content: bytes
    first_sample_t_ns: int
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., t_ns: _Optional[int] = ..., twin: _Optional[str] = ..., sha256: _Optional[str] = ..., content: _Optional[bytes] = ..., first_sample_t_ns: _Optional[int] = ...) -> None: ...

class Consumed(_message.Message):
    __slots__ = ("header", "topic", "first_t_ns", "t_ns")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    TOPIC_FIELD_NUMBER: _ClassVar[int]
    FIRST_T_NS_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    topic: str
    first_t_ns: int
    t_ns: int
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., topic: _Optional[str] = ..., first_t_ns: _Optional[int] = ..., t_ns: _Optional[int] = ...) -> None: ...

class Clock(_message.Message):
    __slots__ = ("header", "t_ns", "rate")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    RATE_FIELD_NUMBER: _ClassVar[int]
    header: Header
    t_ns: int
    rate: float
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., t_ns: _Optional[int] = ..., rate: _Optional[float] = ...) -> None: ...

class Counter(_message.Message):
    __slots__ = ("name", "value")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    name: str
    value: int
    def __init__(self, name: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...

class Input(_message.Message):
    __slots__ = ("key", "producer", "received", "missing", "duplicated", "next_sequence", "missing_at_start", "unsaved")
    KEY_FIELD_NUMBER: _ClassVar[int]
    PRODUCER_FIELD_NUMBER: _ClassVar[int]
    RECEIVED_FIELD_NUMBER: _ClassVar[int]
    MISSING_FIELD_NUMBER: _ClassVar[int]
    DUPLICATED_FIELD_NUMBER: _ClassVar[int]
    NEXT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    MISSING_AT_START_FIELD_NUMBER: _ClassVar[int]
    UNSAVED_FIELD_NUMBER: _ClassVar[int]
    key: str
    producer: str
    received: int
    missing: int
    duplicated: int
    next_sequence: int
    missing_at_start: int
    unsaved: int
    def __init__(self, key: _Optional[str] = ..., producer: _Optional[str] = ..., received: _Optional[int] = ..., missing: _Optional[int] = ..., duplicated: _Optional[int] = ..., next_sequence: _Optional[int] = ..., missing_at_start: _Optional[int] = ..., unsaved: _Optional[int] = ...) -> None: ...

class Output(_message.Message):
    __slots__ = ("key", "published", "has_more")
    KEY_FIELD_NUMBER: _ClassVar[int]
    PUBLISHED_FIELD_NUMBER: _ClassVar[int]
    HAS_MORE_FIELD_NUMBER: _ClassVar[int]
    key: str
    published: int
    has_more: bool
    def __init__(self, key: _Optional[str] = ..., published: _Optional[int] = ..., has_more: _Optional[bool] = ...) -> None: ...

class AwaitedInput(_message.Message):
    __slots__ = ("key", "since_t_ns")
    KEY_FIELD_NUMBER: _ClassVar[int]
    SINCE_T_NS_FIELD_NUMBER: _ClassVar[int]
    key: str
    since_t_ns: int
    def __init__(self, key: _Optional[str] = ..., since_t_ns: _Optional[int] = ...) -> None: ...

class Note(_message.Message):
    __slots__ = ("tray", "text")
    TRAY_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    tray: str
    text: str
    def __init__(self, tray: _Optional[str] = ..., text: _Optional[str] = ...) -> None: ...

class FanLearning(_message.Message):
    __slots__ = ("progress", "missing")
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    MISSING_FIELD_NUMBER: _ClassVar[int]
    progress: float
    missing: str
    def __init__(self, progress: _Optional[float] = ..., missing: _Optional[str] = ...) -> None: ...

class Sweep(_message.Message):
    __slots__ = ("plan", "running", "ended", "asked_t_ns")
    PLAN_FIELD_NUMBER: _ClassVar[int]
    RUNNING_FIELD_NUMBER: _ClassVar[int]
    ENDED_FIELD_NUMBER: _ClassVar[int]
    ASKED_T_NS_FIELD_NUMBER: _ClassVar[int]
    plan: str
    running: str
    ended: str
    asked_t_ns: int
    def __init__(self, plan: _Optional[str] = ..., running: _Optional[str] = ..., ended: _Optional[str] = ..., asked_t_ns: _Optional[int] = ...) -> None: ...

class Learning(_message.Message):
    __slots__ = ("tray", "what", "until_t_ns", "helps", "fans", "sweep")
    TRAY_FIELD_NUMBER: _ClassVar[int]
    WHAT_FIELD_NUMBER: _ClassVar[int]
    UNTIL_T_NS_FIELD_NUMBER: _ClassVar[int]
    HELPS_FIELD_NUMBER: _ClassVar[int]
    FANS_FIELD_NUMBER: _ClassVar[int]
    SWEEP_FIELD_NUMBER: _ClassVar[int]
    tray: str
    what: str
    until_t_ns: int
    helps: str
    fans: _containers.RepeatedCompositeFieldContainer[FanLearning]
    sweep: Sweep
    def __init__(self, tray: _Optional[str] = ..., what: _Optional[str] = ..., until_t_ns: _Optional[int] = ..., helps: _Optional[str] = ..., fans: _Optional[_Iterable[_Union[FanLearning, _Mapping]]] = ..., sweep: _Optional[_Union[Sweep, _Mapping]] = ...) -> None: ...

class AcceptedSamples(_message.Message):
    __slots__ = ("tray", "fans", "command_min", "command_max", "speed_max_rad_s", "named")
    TRAY_FIELD_NUMBER: _ClassVar[int]
    FANS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_MIN_FIELD_NUMBER: _ClassVar[int]
    COMMAND_MAX_FIELD_NUMBER: _ClassVar[int]
    SPEED_MAX_RAD_S_FIELD_NUMBER: _ClassVar[int]
    NAMED_FIELD_NUMBER: _ClassVar[int]
    tray: str
    fans: int
    command_min: float
    command_max: float
    speed_max_rad_s: float
    named: _containers.RepeatedCompositeFieldContainer[NamedFan]
    def __init__(self, tray: _Optional[str] = ..., fans: _Optional[int] = ..., command_min: _Optional[float] = ..., command_max: _Optional[float] = ..., speed_max_rad_s: _Optional[float] = ..., named: _Optional[_Iterable[_Union[NamedFan, _Mapping]]] = ...) -> None: ...

class NamedFan(_message.Message):
    __slots__ = ("name", "place")
    NAME_FIELD_NUMBER: _ClassVar[int]
    PLACE_FIELD_NUMBER: _ClassVar[int]
    name: str
    place: str
    def __init__(self, name: _Optional[str] = ..., place: _Optional[str] = ...) -> None: ...

class LatencyBucket(_message.Message):
    __slots__ = ("upper_s", "count")
    UPPER_S_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    upper_s: float
    count: int
    def __init__(self, upper_s: _Optional[float] = ..., count: _Optional[int] = ...) -> None: ...

class Health(_message.Message):
    __slots__ = ("header", "stage", "instance", "status", "t_ns", "uptime_s", "problem", "inputs", "outputs", "counters", "latency_p50_ms", "latency_p99_ms", "lost", "process_id", "waiting_for", "newest_input_t_ns", "newest_output_t_ns", "notes", "trays", "accepts", "is_last", "latencies", "latency_sum_s", "learning")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STAGE_FIELD_NUMBER: _ClassVar[int]
    INSTANCE_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    UPTIME_S_FIELD_NUMBER: _ClassVar[int]
    PROBLEM_FIELD_NUMBER: _ClassVar[int]
    INPUTS_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    COUNTERS_FIELD_NUMBER: _ClassVar[int]
    LATENCY_P50_MS_FIELD_NUMBER: _ClassVar[int]
    LATENCY_P99_MS_FIELD_NUMBER: _ClassVar[int]
    LOST_FIELD_NUMBER: _ClassVar[int]
    PROCESS_ID_FIELD_NUMBER: _ClassVar[int]
    WAITING_FOR_FIELD_NUMBER: _ClassVar[int]
    NEWEST_INPUT_T_NS_FIELD_NUMBER: _ClassVar[int]
    NEWEST_OUTPUT_T_NS_FIELD_NUMBER: _ClassVar[int]
    NOTES_FIELD_NUMBER: _ClassVar[int]
    TRAYS_FIELD_NUMBER: _ClassVar[int]
    ACCEPTS_FIELD_NUMBER: _ClassVar[int]
    IS_LAST_FIELD_NUMBER: _ClassVar[int]
    LATENCIES_FIELD_NUMBER: _ClassVar[int]
    LATENCY_SUM_S_FIELD_NUMBER: _ClassVar[int]
    LEARNING_FIELD_NUMBER: _ClassVar[int]
    header: Header
    stage: str
    instance: str
    status: StageStatus
    t_ns: int
    uptime_s: float
    problem: str
    inputs: _containers.RepeatedCompositeFieldContainer[Input]
    outputs: _containers.RepeatedCompositeFieldContainer[Output]
    counters: _containers.RepeatedCompositeFieldContainer[Counter]
    latency_p50_ms: float
    latency_p99_ms: float
    lost: int
    process_id: int
    waiting_for: _containers.RepeatedCompositeFieldContainer[AwaitedInput]
    newest_input_t_ns: int
    newest_output_t_ns: int
    notes: _containers.RepeatedCompositeFieldContainer[Note]
    trays: str
    accepts: _containers.RepeatedCompositeFieldContainer[AcceptedSamples]
    is_last: bool
    latencies: _containers.RepeatedCompositeFieldContainer[LatencyBucket]
    latency_sum_s: float
    learning: _containers.RepeatedCompositeFieldContainer[Learning]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., stage: _Optional[str] = ..., instance: _Optional[str] = ..., status: _Optional[_Union[StageStatus, str]] = ..., t_ns: _Optional[int] = ..., uptime_s: _Optional[float] = ..., problem: _Optional[str] = ..., inputs: _Optional[_Iterable[_Union[Input, _Mapping]]] = ..., outputs: _Optional[_Iterable[_Union[Output, _Mapping]]] = ..., counters: _Optional[_Iterable[_Union[Counter, _Mapping]]] = ..., latency_p50_ms: _Optional[float] = ..., latency_p99_ms: _Optional[float] = ..., lost: _Optional[int] = ..., process_id: _Optional[int] = ..., waiting_for: _Optional[_Iterable[_Union[AwaitedInput, _Mapping]]] = ..., newest_input_t_ns: _Optional[int] = ..., newest_output_t_ns: _Optional[int] = ..., notes: _Optional[_Iterable[_Union[Note, _Mapping]]] = ..., trays: _Optional[str] = ..., accepts: _Optional[_Iterable[_Union[AcceptedSamples, _Mapping]]] = ..., is_last: _Optional[bool] = ..., latencies: _Optional[_Iterable[_Union[LatencyBucket, _Mapping]]] = ..., latency_sum_s: _Optional[float] = ..., learning: _Optional[_Iterable[_Union[Learning, _Mapping]]] = ...) -> None: ...
