"""Samples as JSON, the form that sources over MQTT and HTTP share: docs/reference/json-samples.md."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from fantwin.pipeline.sources.own_json import OwnSamples, number_of, of_fan, value_at
from fantwin.pipeline.sources.source import Reading, ReadingBatch, Rejected
from fantwin.pipeline.timebase.device_clock import NS_PER_US, UINT32
from fantwin.pipeline.timebase.receipt_times import ReceiptTimes
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.messages import FURTHEST_T_NS, LARGEST_PERIOD_NS
from fantwin.schemas.units import NS_PER_S

LARGEST_BYTES = 1 << 20
"""size of one text"""
MOST_SAMPLES = 4096
"""samples in one text"""
_OTHERS = tuple(column.name for column in CHANNELS)
_OF_FAN = ("command", "speed", *_OTHERS)
_OF_SAMPLE = ("t", "sequence", "fans", *_OF_FAN)
_UNIX_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class JsonSamplesError(ValueError):
    """A text that is not samples: one line that says why."""


@dataclass(frozen=True, slots=True)
class TimedReading:
    """A reading and the time that its sender gives it, ns since 1970; None: it gives none."""

    reading: Reading
    t_ns: int | None


def parse_samples(
    text: bytes, own: OwnSamples | None = None, fans: int = 0, speed_unit: str = ""
) -> list[TimedReading | Rejected]:
    """Parse each of the samples in a text. own: where the values of the fans are in JSON of the device's own.

    Raises:
        JsonSamplesError: it is no JSON, too long, or neither a sample nor a list of samples.
    """
    if own is None or not own.speed_key:
        return _timed(_listed(text), _timed_reading)
    return _timed(_listed(text), lambda sample: _own_reading(sample, own, fans, speed_unit))


def _listed(text: bytes) -> list[Any]:
    """The samples of a text: one, a list, or an object with nothing but a list."""
    if len(text) > LARGEST_BYTES:
        raise JsonSamplesError(f"{len(text)} bytes: at most {LARGEST_BYTES} are accepted at once")
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise JsonSamplesError(f"no JSON: {str(error) or 'nested too deeply'}") from error
    if isinstance(value, dict) and set(value) in ({"samples"}, {"metrics"}):
        (value,) = value.values()
    samples = value if isinstance(value, list) else [value]
    if len(samples) > MOST_SAMPLES:
        raise JsonSamplesError(f"{len(samples)} samples: at most {MOST_SAMPLES} are accepted at once")
    return samples


def _timed(samples: list[Any], reading_of: Callable[[Any], TimedReading]) -> list[TimedReading | Rejected]:
    found: list[TimedReading | Rejected] = []
    newest_t_ns: int | None = None
    for sample in samples:
        if not isinstance(sample, dict):
            raise JsonSamplesError('a sample is {"t": ..., "command": [...], "speed": [...]}, or a list of such')
        try:
            timed = reading_of(sample)
        except ValueError as error:
            found.append(Rejected("malformed", str(error), is_sample=True))
            continue
        if timed.t_ns is not None:
            if newest_t_ns is not None and not 0 < timed.t_ns - newest_t_ns < LARGEST_PERIOD_NS:
                found.append(Rejected("time_order", "t does not increase, or by more than a day", is_sample=True))
                continue
            newest_t_ns = timed.t_ns
        found.append(timed)
    return found


def batches_of(
    found: Sequence[TimedReading | Rejected], received_t_ns: int, receipts: ReceiptTimes, byte_count: int
) -> list[ReadingBatch]:
    """Split samples that came together into batches: one that is older than the newest was kept by its sender."""
    times = [each.t_ns for each in found if isinstance(each, TimedReading) and each.t_ns is not None]
    newest_t_ns = times[-1] if times else 0
    ages_ns = [
        newest_t_ns - each.t_ns if isinstance(each, TimedReading) and each.t_ns is not None else 0 for each in found
    ]
    receipt_t_ns = receipts.of(received_t_ns, ages_ns)
    items = [each.reading if isinstance(each, TimedReading) else each for each in found]
    return [
        ReadingBatch(t_ns, (item,), byte_count if row == 0 else 0)
        for row, (t_ns, item) in enumerate(zip(receipt_t_ns, items, strict=True))
    ]


def command_json(command: Sequence[float], set_point: Sequence[float]) -> str:
    """A command, or set-points, as a program gets them: null leaves a fan as it is."""
    given = {"command": command, "set_point": set_point}
    return json.dumps({name: [None if math.isnan(x) else x for x in each] for name, each in given.items() if each})


def _timed_reading(sample: Mapping[str, Any]) -> TimedReading:
    unknown = [key for key in sample if key not in _OF_SAMPLE]
    if unknown:
        raise ValueError(f"unknown key {unknown[0][:40]!r}; known: {', '.join(_OF_SAMPLE)}")
    if "fans" in sample:
        sample = {**{key: sample[key] for key in ("t", "sequence") if key in sample}, **_by_column(sample)}
    columns = {name: _numbers(name, sample[name]) for name in _OF_FAN if name in sample}
    if "speed" not in columns:
        raise ValueError("'speed' is missing")
    columns.setdefault("command", (math.nan,) * len(columns["speed"]))
    t_ns = _time_ns(sample["t"]) if sample.get("t") is not None else None
    clock_us = None if t_ns is None else (t_ns + NS_PER_US // 2) // NS_PER_US % UINT32
    reading = Reading(
        columns.pop("command"), columns.pop("speed"), clock_us, _sequence(sample.get("sequence")), measured=columns
    )
    return TimedReading(reading, t_ns)


def _own_reading(sample: Mapping[str, Any], own: OwnSamples, fans: int, speed_unit: str) -> TimedReading:
    def values(key: str, **how: Any) -> tuple[float, ...]:
        found: list[float] = []
        for fan in range(fans):
            pointer = of_fan(key, fan)
            value = value_at(sample, pointer)
            if (number := number_of(value, **how)) is None:
                raise ValueError(f"{pointer} has {str(value)[:40]!r}, which is no number")
            found.append(number)
        return tuple(found)

    t_ns = _time_ns(value_at(sample, own.time_key)) if own.time_key else None
    clock_us = None if t_ns is None else (t_ns + NS_PER_US // 2) // NS_PER_US % UINT32
    return TimedReading(Reading(values(own.command_key), values(own.speed_key, speed_unit=speed_unit), clock_us), t_ns)


def _by_column(sample: Mapping[str, Any]) -> dict[str, list[Any]]:
    """The columns of a sample with an object for each fan."""
    fans = sample["fans"]
    if any(name in sample for name in _OF_FAN):
        raise ValueError("give 'fans' or 'command' and 'speed', not both")
    if not isinstance(fans, list) or not all(isinstance(fan, dict) for fan in fans):
        raise ValueError('\'fans\' is a list of {"command": ..., "speed": ...}')
    unknown = [key for fan in fans for key in fan if key not in _OF_FAN]
    if unknown:
        raise ValueError(f"unknown key {unknown[0][:40]!r} of a fan; known: {', '.join(_OF_FAN)}")
    names = ("command", "speed", *(name for name in _OTHERS if any(name in fan for fan in fans)))
    return {name: [fan.get(name) for fan in fans] for name in names}


def _numbers(name: str, values: Any) -> tuple[float, ...]:
    values = values if isinstance(values, list) else [values]
    return tuple(_number(name, value) for value in values)


def _number(name: str, value: Any) -> float:
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name!r} has {str(value)[:40]!r}, which is no number")
    try:
        return float(value)
    except OverflowError as error:
        raise ValueError(f"{name!r} has a number that is too large") from error


def _sequence(value: Any) -> int | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError("'sequence' is a whole number from 0 on")
    return value % UINT32


def _time_ns(t: Any) -> int:
    """ns since 1970 of seconds, or of a date with a time zone."""
    if isinstance(t, str):
        try:
            date = datetime.fromisoformat(t)
        except ValueError as error:
            raise ValueError(f"'t' = {t[:40]!r} is no date: 2026-01-31T13:45:00.250Z") from error
        if date.tzinfo is None:
            raise ValueError(f"'t' = {t[:40]!r} has no time zone: end it with Z")
        t_ns = (date - _UNIX_EPOCH) // timedelta(microseconds=1) * NS_PER_US
    else:
        seconds = _number("t", t)
        if not math.isfinite(seconds):
            raise ValueError("'t' is no time")
        t_ns = math.floor(seconds) * NS_PER_S + round((seconds - math.floor(seconds)) * NS_PER_S)
    if abs(t_ns) >= FURTHEST_T_NS:
        raise ValueError("'t' is beyond the year 2116: it is in seconds")
    return t_ns
