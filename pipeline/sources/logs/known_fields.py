"""Fields of logs that are known: where their values are measured, and which are of fans. A new field is a row."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fantwin.pipeline.sources.logs.log_file import LogFile, Series


class LogFans(NamedTuple):
    """Commands and speeds of the fans of a log, with `*` for their number, behind any name. commands: the first that a
    log has."""

    speed: str
    unit: str
    commands: tuple[str, ...]


LOG_FANS = (
    LogFans("esc_status.esc[*].esc_rpm", "rpm", ("actuator_motors.control[*]", "actuator_outputs.output[*]")),
    LogFans("mavros/esc_status.esc_status[*].rpm", "rpm", ("mavros/rc/out.channels[*]",)),
)


class MeasuredWhere(NamedTuple):
    """Values that are measured only in some samples; in the others they are those of a silent device, or old ones.

    fields: pattern of their names. by: name of the field that says where, with the groups of the pattern. With the
    group `bit` they are measured where this bit is set, without it where that field changes, as the time of a reading.
    """

    fields: str
    by: str


_OF_ESC = r"(?P<topic>.*\besc_status(?:#\d+)?)\.esc\[{}\]\.esc_(?:rpm|voltage|current|temperature)"
MEASURED_WHERE = (
    MeasuredWhere(_OF_ESC.format(r"(?P<bit>\d+)"), "{topic}.esc_online_flags"),
    MeasuredWhere(_OF_ESC.format(r"(?P<esc>\d+)"), "{topic}.esc[{esc}].timestamp"),
)
STOPPED_WHERE_NAN = (r".*\bactuator_motors(?:#\d+)?\.control\[\d+\]",)
"""commands that are NaN while a motor is stopped, so that the one before does not hold"""


class Unmeasured(NamedTuple):
    """Values of a field that are left out: how many, and where."""

    field: str
    values: int
    where: str


def read_measured(log: LogFile, names: Sequence[str]) -> tuple[dict[str, Series], list[Unmeasured]]:
    """These fields of a log, NaN where they are not measured, and what is left out by that."""
    there = set(log.names)
    rules = [(name, by, bit) for name in names for by, bit in _rules_of(name) if by in there]
    series = dict(log.read(list(dict.fromkeys((*names, *(by for _, by, _ in rules))))))
    unmeasured: list[Unmeasured] = []
    for name, by, bit in rules:
        told, (t_ns, values) = series[by].values, (series[name].t_ns, series[name].values)
        if len(told) != len(values):
            continue
        if bit:
            is_measured = (told.astype(np.int64) >> int(bit)) & 1 == 1
            where = f"the bit of the motor in {by} is not set"
        else:
            is_measured = np.diff(told, prepend=0.0) != 0  # 0: not yet
            where = "readings are repeated, by their own timestamps"
        if is_measured.sum() > 1 and not is_measured.all():
            series[name] = Series(t_ns, np.where(is_measured, values, np.nan))
            unmeasured.append(Unmeasured(name, int(np.count_nonzero(~is_measured & np.isfinite(values))), where))
    return {name: series[name] for name in names}, unmeasured


def _rules_of(name: str) -> Iterator[tuple[str, str]]:
    """The fields that say where another is measured, each with the bit, if it is one."""
    for rule in MEASURED_WHERE:
        if match := re.fullmatch(rule.fields, name):
            groups = match.groupdict()
            yield rule.by.format_map(groups), groups.get("bit", "")


def stops_where_nan(name: str) -> bool:
    """Whether a command of this name is NaN while its motor is stopped."""
    return any(re.fullmatch(each, name) for each in STOPPED_WHERE_NAN)


def known_columns(names: Sequence[str]) -> Mapping[str, str]:
    """Patterns of the commands and speeds of the fans of a log, as `--command` and `--speed` take them; empty: they are
    not known."""
    for fans in LOG_FANS:
        first = fans.speed.replace("*", "0")
        for before in (name.removesuffix(first) for name in names if name.endswith(first)):
            for command in fans.commands:
                if f"{before}{command.replace('*', '0')}" in names:
                    return {"--command": f"{before}{command}", "--speed": f"{before}{fans.speed}:{fans.unit}"}
    return {}
