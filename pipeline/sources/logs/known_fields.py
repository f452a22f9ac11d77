"""Fields of logs that are known: where their values are measured, and which are of fans. A new field is a row."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fantwin.pipeline.sources.logs.log_file import LogFile, Series

_PX4 = r"(?P<topic>.*\besc_status(?:#\d+)?)"
_PX4_SPEED = re.compile(r"(?P<before>.*)\besc_status\.esc\[\d+\]\.esc_rpm")
PX4_COMMANDS = ("actuator_motors.control[*]", "actuator_outputs.output[*]")
"""beside the speeds in `esc_status`; the first that a log has"""


class MeasuredWhere(NamedTuple):
    """Values that are measured only where a bit of another field is set; elsewhere they are those of a silent device.

    fields: pattern of their names, with the group `bit`. flags: name of that field, with the groups of the pattern.
    """

    fields: str
    flags: str


MEASURED_WHERE = (
    MeasuredWhere(rf"{_PX4}\.esc\[(?P<bit>\d+)\]\.esc_(?:rpm|voltage|current|temperature)", "{topic}.esc_online_flags"),
)
STOPPED_WHERE_NAN = (r".*\bactuator_motors(?:#\d+)?\.control\[\d+\]",)
"""commands that are NaN while a motor is stopped, so that the one before does not hold"""


def read_measured(log: LogFile, names: Sequence[str]) -> tuple[dict[str, Series], dict[str, tuple[str, int]]]:
    """These fields of a log, NaN where they are not measured; of each such one what says so, and how often."""
    there = set(log.names)
    flags = {name: found for name in names if (found := _flags_of(name)) and found[0] in there}
    series = dict(log.read(list(dict.fromkeys((*names, *(field for field, _ in flags.values()))))))
    unmeasured: dict[str, tuple[str, int]] = {}
    for name, (field, bit) in flags.items():
        is_set = (series[field].values.astype(np.int64) >> bit) & 1 == 1
        values = series[name].values
        if is_set.any() and len(is_set) == len(values) and not is_set.all():
            series[name] = Series(series[name].t_ns, np.where(is_set, values, np.nan))
            unmeasured[name] = field, int(np.count_nonzero(~is_set))
    return {name: series[name] for name in names}, unmeasured


def _flags_of(name: str) -> tuple[str, int] | None:
    """The field whose bit says where another is measured, and the bit."""
    for rule in MEASURED_WHERE:
        if match := re.fullmatch(rule.fields, name):
            return rule.flags.format_map(match.groupdict()), int(match["bit"])
    return None


def stops_where_nan(name: str) -> bool:
    """Whether a command of this name is NaN while its motor is stopped."""
    return any(re.fullmatch(each, name) for each in STOPPED_WHERE_NAN)


def known_columns(names: Sequence[str]) -> Mapping[str, str]:
    """Patterns of the commands and speeds of the fans of a log, as `--command` and `--speed` take them; empty: they are
    not known."""
    speed = next((match for name in names if (match := _PX4_SPEED.fullmatch(name))), None)
    for command in PX4_COMMANDS if speed else ():
        if speed and f"{speed['before']}{command.replace('*', '0')}" in names:
            before = speed["before"]
            return {"--command": f"{before}{command}", "--speed": f"{before}esc_status.esc[*].esc_rpm:rpm"}
    return {}
