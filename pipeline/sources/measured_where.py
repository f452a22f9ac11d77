"""Fields of which only some values are measurements, and commands that stop a motor. A new field is a row."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fantwin.pipeline.sources.column_file import Column, ColumnFile


class MeasuredWhere(NamedTuple):
    """Values that are measured only in some samples; in the others they are those of a silent device, or old ones.

    fields: pattern of their names. by: name of the field that says where, with the groups of the pattern. With the
    group `bit` they are measured where this bit is set, without it where that field changes, as the time of a reading.
    """

    fields: str
    by: str


_OF_ESC = r"(?P<topic>(?:.*\besc_status(?:#\d+)?\.)?)esc\[{}\]\.esc_(?:rpm|voltage|current|temperature)"
MEASURED_WHERE = (
    MeasuredWhere(_OF_ESC.format(r"(?P<bit>\d+)"), "{topic}esc_online_flags"),
    MeasuredWhere(_OF_ESC.format(r"(?P<esc>\d+)"), "{topic}esc[{esc}].timestamp"),
)
STOPPED_WHERE_NAN = (r"(?:.*\bactuator_motors(?:#\d+)?\.)?control\[\d+\]",)
"""commands that are NaN while a motor is stopped, so that the one before does not hold"""


class LeftOut(NamedTuple):
    """Values of a column that are left out: how many, and why."""

    name: str
    values: int
    why: str


def read_measured(file: ColumnFile, names: Sequence[str]) -> tuple[Mapping[str, Column], list[LeftOut]]:
    """These columns of a file, NaN where they are not measured, and what is left out by that."""
    there = set(file.names)
    rules = [(name, by, bit) for name in names for by, bit in _rules_of(name) if by in there]
    columns = dict(file.read(list(dict.fromkeys((*names, *(by for _, by, _ in rules))))))
    left_out: list[LeftOut] = []
    for name, by, bit in rules:
        shown, values = columns[by].values, columns[name].values
        if len(shown) != len(values):
            continue
        if bit:
            is_measured = (np.nan_to_num(shown).astype(np.int64) >> int(bit)) & 1 == 1
            why = f"where the bit of the motor in {by} is not set"
        else:
            is_measured = np.diff(shown, prepend=0.0) != 0  # 0: not yet
            why = "where readings are repeated, by their own timestamps"
        if is_measured.sum() > 1 and not is_measured.all():
            columns[name] = replace(columns[name], values=np.where(is_measured, values, np.nan))
            left_out.append(LeftOut(name, int(np.count_nonzero(~is_measured & np.isfinite(values))), why))
    return {name: columns[name] for name in names}, left_out


def _rules_of(name: str) -> Iterator[tuple[str, str]]:
    """The fields that say where another is measured, each with the bit, if it is one."""
    for rule in MEASURED_WHERE:
        if match := re.fullmatch(rule.fields, name):
            groups = match.groupdict()
            yield rule.by.format_map(groups), groups.get("bit", "")


def stops_where_nan(name: str) -> bool:
    """Whether a command of this name is NaN while its motor is stopped."""
    return any(re.fullmatch(each, name) for each in STOPPED_WHERE_NAN)
