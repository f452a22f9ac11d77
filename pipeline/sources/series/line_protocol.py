"""Line protocol of InfluxDB, as Telegraf writes it to files: `measurement,tag=value field=1,other=2i time`."""

from __future__ import annotations

import re
from array import array
from pathlib import Path

import numpy as np

from fantwin.pipeline.sources.series.series_file import Label, SeriesFile, named
from fantwin.schemas.messages import FURTHEST_T_NS
from fantwin.schemas.units import NS_PER_S

_NAME = r"(?:\\.|[^\\, =\n])+"
_TAGS = re.compile(rf",(?P<key>{_NAME})=(?P<value>{_NAME})")
_FIELDS = re.compile(rf'(?P<key>{_NAME})=(?P<value>"(?:\\.|[^"\\])*"|[^, \n]+)')
_LINE = re.compile(
    rf'(?P<name>(?:\\.|[^\\, \n])+)(?P<tags>(?:,{_NAME}={_NAME})*) (?P<fields>(?:[^" \n]|"(?:\\.|[^"\\])*")+)'
    r"(?: (?P<time>-?\d+))?\s*"
)
_VALUE = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)[iu]?")
_PRECISION = ((17, 1), (14, 1_000), (11, 1_000_000), (0, NS_PER_S))
"""digits of a time since 1970 and ns of its unit"""
_LONGEST_LINE = 1 << 20


def is_line_protocol(start: str) -> bool:
    """Whether a file begins with a line of it that has a time."""
    line = next((each for each in start.splitlines() if each and not each.startswith("#")), "")
    found = _LINE.fullmatch(line)
    return bool(found and found["time"] and len(found["time"]) >= 10 and _FIELDS.match(found["fields"]))


def read_line_protocol(path: Path) -> SeriesFile:
    """The series of a file: `measurement.field{tag=value}`, without the measurement if there is only one."""
    times: dict[tuple[str, str, str], array[int]] = {}
    values: dict[tuple[str, str, str], array[float]] = {}
    damaged: list[int] = []
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if not line.strip() or line.startswith("#"):
                continue
            found = _LINE.fullmatch(line) if len(line) < _LONGEST_LINE else None
            time = found["time"] or "" if found else ""
            t_ns = int(time or 0) * next(ns for digits, ns in _PRECISION if len(time) >= digits)
            if found is None or not time or abs(t_ns) >= FURTHEST_T_NS:
                damaged.append(number)
                continue
            for each in _FIELDS.finditer(found["fields"]):
                if value := _VALUE.fullmatch(each["value"]):
                    key = (found["name"], found["tags"], each["key"])
                    times.setdefault(key, array("q")).append(t_ns)
                    values.setdefault(key, array("d")).append(float(value[1]))
    several = len({name for name, _, _ in times}) > 1
    series = named(
        (
            Label(
                f"{_plain(name)}.{_plain(field)}" if several else _plain(field),
                tuple((_plain(each["key"]), _plain(each["value"])) for each in _TAGS.finditer(tags)),
            ),
            np.asarray(times[name, tags, field]),
            np.asarray(values[name, tags, field]),
        )
        for name, tags, field in times
    )
    notes = (
        (f"{len(damaged)} lines left out: not line protocol with a time, first line {damaged[0]}",) if damaged else ()
    )
    return SeriesFile(f"InfluxDB line protocol, {len(series)} series", series, notes)


def _plain(text: str) -> str:
    return re.sub(r"\\(.)", r"\1", text)
