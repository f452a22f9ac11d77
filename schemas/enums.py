"""The enumerations of the messages; the values are those of `fan.proto`."""

from __future__ import annotations

from fantwin.schemas.fields import OpenEnum


class InvalidReason(OpenEnum):
    """Why a sample is not scored."""

    NONE = 0
    STALE = 1
    GAP = 2
    WARMING_UP = 3
    OUT_OF_RANGE = 4
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
    STOPPED = 5
    STARTING = 6


class Statistic(OpenEnum):
    """The statistics that are compared with limits; the values number them across messages and snapshots."""

    NONE = 0
    DEVIATION = 1
    MISSING_READINGS = 2
    STANDSTILL = 3
    WEAR = 4


class Transition(OpenEnum):
    """What happened to an alarm, in the terms of OPC UA Part 9."""

    NONE = 0
    RAISED = 1
    SEVERITY = 2
    DIAGNOSED = 3
    CLEARED = 4
    ACKNOWLEDGED = 5
    SHELVED = 6
    UNSHELVED = 7
    OUT_OF_SERVICE = 8
    IN_SERVICE = 9
    COMMISSIONING = 10
    REPUBLISHED = 11
    REFUSED = 12
    DATA_LOST = 13
    DATA_RESTORED = 14
    MARKED_TRUE = 15
    MARKED_FALSE = 16
    COMMENTED = 17


class Action(OpenEnum):
    """What an operator can request."""

    NONE = 0
    ACKNOWLEDGE = 1
    SHELVE = 2
    UNSHELVE = 3
    OUT_OF_SERVICE = 4
    IN_SERVICE = 5
    COMMISSION = 6
    TRUE_ALARM = 7
    FALSE_ALARM = 8
    COMMENT = 9
    SWEEP = 10
    STOP_SWEEP = 11


class Feedback(OpenEnum):
    """What operators have said of an alarm."""

    NONE = 0
    TRUE_ALARM = 1
    FALSE_ALARM = 2


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
