"""What an object of a fan says, whatever schema it is of: Thermal, Fan, EnvironmentMetrics, Sensor, or nearly one.

A speed is what is given in rpm. `SpeedPercent.Reading` is by its schema the measured speed over the rated one, so it is
never a command (Redfish Data Model Specification, DSP0268: Fan).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from fantwin.pipeline.sources.own_json import found_at, has, number_at
from fantwin.schemas.fan_names import is_fan_name, is_one_short_line

Json = Mapping[str, Any]
NAMES = ("Name", "FanName", "DeviceName", "MemberId", "Id")
NOT_MEASURED = ("Absent", "Disabled", "StandbyOffline", "UnavailableOffline")
"""values of Status.State of a fan that is not there, or off with its server"""
SET_POINT = "/SpeedControlPercent/SetPoint"
MEASURED_PERCENT = "/SpeedPercent/Reading"
_RPM_KEYS = ("/SpeedPercent/SpeedRPM", "/SpeedRPM", "/ReadingRPM")
_READINGS = (("/Reading", "/ReadingUnits"), ("/CurrentReading", "/Units"))
_RPM_UNITS = ("rpm", "rpms", "{rev}/min", "1/min", "r/min", "rev/min")
_PERCENT_UNITS = ("percent", "%")
_LARGEST_PERCENT = 100.0
_RANGES = ("MaxReadingRange", "LowerThresholdCritical", "LowerThresholdNonCritical", "LowerThresholdFatal")
"""keys in the unit of the reading, which tell rpm from per cent"""
_NO_MEASUREMENT = re.compile(
    r"threshold|range|/status/|ordinal|number|count|@odata|/redundancy/|hysteresis|memberid|id$|name$", re.I
)
_SIDES = {"tach", "tacho", "fantach", "fanpwm", "pwm", "rpm", "duty", "speed", "percent", "il", "ol", "sensor"}
"""words of the names of a tacho and of the pwm that drives its fan in which they differ"""


@dataclass
class FanObject:
    """A fan as the controller lists it. why_unread: empty if it could be read.

    sensor: where its speed comes from, set before its speed is asked for.
    """

    own: Json
    sensor: Json = field(default_factory=dict[str, Any])
    why_unread: str = ""

    @cached_property
    def keys(self) -> list[str]:
        """What it may be called by in `source.fans`, the best one first."""
        return [str(self.own[key]) for key in NAMES if self.own.get(key) not in (None, "")]

    @property
    def called(self) -> str:
        """What people see; empty where that can be no name."""
        return next((name for key in NAMES[:3] if is_fan_name(name := str(self.own.get(key, "")))), "")

    @property
    def place(self) -> str:
        """Where the controller says it is, by the label on the chassis or by the context; may be empty."""
        label = found_at(self.own, "/Location/PartLocation/ServiceLabel")
        places = (str(each) for each in (label, self.own.get("PhysicalContext")) if each)
        return next(filter(is_one_short_line, places), "")

    @cached_property
    def is_measured(self) -> bool:
        """False where it is absent, or off."""
        return found_at(self.own, "/Status/State") not in NOT_MEASURED

    @property
    def rpm_at(self) -> str:
        """Where its speed in rpm is; empty if nowhere."""
        return rpm_at(self.own) or rpm_at(self.sensor)

    @property
    def rpm(self) -> float:
        """NaN where it is not measured now."""
        if not self.is_measured:
            return math.nan
        own = number_at(self.own, rpm_at(self.own))
        return number_at(self.sensor, rpm_at(self.sensor)) if math.isnan(own) else own

    @property
    def percent(self) -> float:
        """Its speed over the rated one, per cent; NaN where there is none."""
        if not self.is_measured:
            return math.nan
        found = (number_at(each, percent_at(each)) for each in (self.own, self.sensor))
        return next((value for value in found if not math.isnan(value)), math.nan)

    @property
    def has_percent(self) -> bool:
        """Whether it gives per cent, also where there is no value now."""
        return bool(percent_at(self.own) or percent_at(self.sensor))

    @property
    def is_pwm(self) -> bool:
        """Whether it is no fan but a pwm, which OpenBMC lists beside them."""
        return self.has_percent and not self.rpm_at and is_pwm_name(" ".join(self.keys))

    @property
    def numbers(self) -> str:
        """What else it has, for people: `Reading 4100, Oem/Vendor/PWM 40`."""
        found = [f"{pointer[1:]} {value:g}" for pointer, value in _numbers(self.own) if not _is_limit(pointer)]
        return ", ".join(found[:6]) or "no number"


def rpm_at(value: Json) -> str:
    """The pointer of the speed in rpm of an object; empty if it has none."""
    found = [pointer for pointer in _RPM_KEYS if has(value, pointer)]
    if found and not math.isnan(number_at(value, found[0])):
        return found[0]
    for reading, units in _READINGS:
        if not has(value, reading):
            continue
        unit = str(found_at(value, units) or "").strip().lower()
        is_rotational = not unit and (value.get("ReadingType") == "Rotational" or _is_beyond_percent(value, reading))
        if unit in _RPM_UNITS or is_rotational:
            found.append(reading)
    numbers = [pointer for pointer in found if not math.isnan(number_at(value, pointer))]
    return next(iter(numbers or found), "")


def percent_at(value: Json) -> str:
    """The pointer of a reading in per cent; empty if there is none."""
    if has(value, MEASURED_PERCENT) and not number_at(value, MEASURED_PERCENT) > _LARGEST_PERCENT:
        return MEASURED_PERCENT
    for reading, units in _READINGS:
        if has(value, reading) and str(found_at(value, units) or "").strip().lower() in _PERCENT_UNITS:
            return reading
    return ""


def link(value: Any) -> str:
    """The path that a link leads to; empty if it is none."""
    return str(value.get("@odata.id", "")) if isinstance(value, Mapping) else ""


def listed(value: Json, key: str) -> list[Json]:
    """The objects of a list."""
    found = value.get(key)
    return [each for each in found if isinstance(each, Mapping)] if isinstance(found, list) else []


def last_part(path: str) -> str:
    """The id at the end of a path."""
    return path.rstrip("/").rpartition("/")[2]


def is_pwm_name(name: str) -> bool:
    """Whether something is called a pwm."""
    return "pwm" in name.lower() or "duty" in name.lower()


def stem(name: str) -> str:
    """The words of a name that a tacho and the pwm of its fan share: of `fantach_SYS_FAN1_RPM`, `sys fan1`. Empty where
    nothing but a number is left, which may count pwms otherwise than fans."""
    words = [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word and word not in _SIDES]
    return "".join(words) if any(word.strip("0123456789") for word in words) else ""


def _is_beyond_percent(value: Json, reading: str) -> bool:
    """Whether a reading without a unit, or a limit of it, is too large for per cent."""
    return any(number_at(value, pointer) > _LARGEST_PERCENT for pointer in (reading, *(f"/{key}" for key in _RANGES)))


def _is_limit(pointer: str) -> bool:
    return bool(_NO_MEASUREMENT.search(pointer))


def _numbers(value: Json, pointer: str = "") -> Iterator[tuple[str, float]]:
    for key, each in value.items():
        here = f"{pointer}/{key}"
        if isinstance(each, Mapping):
            yield from _numbers(each, here)
        elif not math.isnan(number := number_at(value, f"/{key.replace('~', '~0').replace('/', '~1')}")):
            yield here, number
