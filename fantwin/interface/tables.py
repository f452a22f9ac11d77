"""Tables of other libraries as samples of fans, and results as a table of the same library.

A table is a pandas DataFrame, a pyarrow Table or a mapping of names to arrays. None of the libraries is imported: the
table that was given leads to its own.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fantwin.interface.columns import SUFFIX_OF_UNIT, Columns, Fan, FoundColumns, find_columns
from fantwin.interface.words import warn
from fantwin.pipeline.errors import FantwinError
from fantwin.pipeline.sources.column_file import NO_TIME
from fantwin.pipeline.sources.tables.fan_columns import FanColumns
from fantwin.pipeline.sources.tables.measured_table import Table, table_of
from fantwin.pipeline.sources.tables.units import RAD_S_PER_TABLE_UNIT
from fantwin.schemas.messages import FURTHEST_T_NS
from fantwin.schemas.units import NS_PER_S

Array: TypeAlias = NDArray[Any]
TimesAre: TypeAlias = Literal["seconds", "dates", "durations"]
NAME = Path("the table")
"""name of a table in errors, where other data have a file"""
_LEAST_SHARED = 0.5
"""share of the samples of a long table that the fans must have at common times"""
_SHOWN = 6


@dataclass(frozen=True)
class Form:
    """How a table was given, and so how results are.

    Attributes:
        make: makes a table of columns by name, and of the time zone of dates, which come in UTC.
        times_are: seconds, dates or durations.
        zone: of dates; None: none was given.
        unit: of speeds.
    """

    make: Callable[[dict[str, Array], Any], Any]
    times_are: TimesAre = "seconds"
    zone: Any = None
    unit: str = "rpm"

    def times(self, t_ns: Array) -> Array:
        """(n,) times in ns as those of the table; unknown where they are below the first possible one."""
        known = t_ns > -FURTHEST_T_NS
        if self.times_are == "seconds":
            return np.where(known, t_ns / NS_PER_S, np.nan)
        kind = "datetime64[ns]" if self.times_are == "dates" else "timedelta64[ns]"
        return np.where(known, t_ns, NO_TIME).view(kind)

    def speed_column(self, name: str) -> str:
        """The name of a column of speeds, with their unit at its end."""
        return f"{name}_{SUFFIX_OF_UNIT[self.unit]}"

    def in_unit(self, speed_rad_s: Array) -> Array:
        """Speeds in the unit of the table."""
        return np.asarray(speed_rad_s, np.float64) / RAD_S_PER_TABLE_UNIT[self.unit]


@dataclass(frozen=True)
class FanTable:
    """Samples of fans from a table. fans: their numbers or names, in the order of the columns of `samples`."""

    samples: Table
    fans: tuple[Fan, ...]
    form: Form

    def of_each(self, fans: Sequence[Fan]) -> FanTable:
        """The samples of its only fan as those of each of these."""
        each = {name: np.repeat(values, len(fans), axis=1) for name, values in self.samples.auxiliary.items()}
        command, speed = (np.repeat(of, len(fans), axis=1) for of in (self.samples.command, self.samples.speed_rad_s))
        samples = replace(self.samples, command=command, speed_rad_s=speed, auxiliary=each)
        return replace(self, samples=samples, fans=tuple(fans))


@dataclass(frozen=True)
class _Samples:
    """(n,) times in ns and whether they are known, and (n,) columns by what they hold and by fan."""

    t_ns: Array
    known: Array
    fans: tuple[Fan, ...]
    values: Mapping[tuple[str, Fan], Array]


def fan_table(table: Any, wanted: Columns, *, needs_speed: bool = True) -> FanTable:
    """The samples of a table; what was repaired in it is said in a warning. Without a column of the speed, all are NaN.

    Raises:
        FantwinError: it is no table, or a column is missing or cannot be used.
    """
    if not isinstance(wanted, Columns):
        raise FantwinError(f'columns must be fantwin.Columns, such as fantwin.Columns(command="NAME"), not {wanted!r}')
    columns, make = _columns_and_maker(table)
    found = find_columns(list(columns), wanted, needs_speed=needs_speed)
    t_ns, known, times_are, zone = _times(found.time, columns[found.time], found.ns_per_unit)
    if not len(t_ns):
        raise FantwinError(f"{NAME} has no rows")
    of = (_long if found.fan else _wide)(found, columns, t_ns, known)
    named = {f"{what} of fan {fan}": values for (what, fan), values in of.values.items()}
    unknown = np.full(len(of.t_ns), np.nan)
    chosen = FanColumns(
        command=tuple(f"command of fan {fan}" for fan in of.fans),
        speed=tuple(f"speed of fan {fan}" for fan in of.fans),
        others={what: tuple(f"{what} of fan {fan}" for fan in of.fans) for what in found.others},
    )
    named = {name: named.get(name, unknown) for name in chosen.names}
    unit = found.unit or "rpm"
    samples = table_of(NAME, chosen, named, np.where(of.known, of.t_ns, NO_TIME), RAD_S_PER_TABLE_UNIT[unit], unit)
    if not found.speed:
        samples = replace(samples, repairs=replace(samples.repairs, speeds_missing=0))
    lines = [f"{NAME}: {note}" for note in samples.notes]
    if not found.fan and 2 * samples.repairs.repeated > samples.repairs.rows:
        lines[-1] = f'{NAME}: most times repeat; of several fans name their column: fantwin.Columns(fan="NAME")'
    warn(lines)
    return FanTable(samples, of.fans, Form(make, times_are, zone, unit))


def _wide(found: FoundColumns, columns: Mapping[str, Any], t_ns: Array, known: Array) -> _Samples:
    by_fan = {"command": found.command, "speed": found.speed, **found.others}
    values = {
        (what, fan): _numbers(name, columns[name]) for what, of in by_fan.items() for fan, name in of.items() if name
    }
    return _Samples(t_ns, known, _in_order(tuple(found.speed or found.command)), values)


def _in_order(fans: tuple[Fan, ...]) -> tuple[Fan, ...]:
    """Numbers rise, whatever the order of their columns or rows; names stay as they are."""
    return tuple(sorted(fans)) if all(isinstance(fan, int) for fan in fans) else fans


def _long(found: FoundColumns, columns: Mapping[str, Any], t_ns: Array, known: Array) -> _Samples:
    of_rows = _labels(found.fan, columns[found.fan])
    fans = _in_order(tuple(dict.fromkeys(of_rows.tolist())))
    rows = [np.flatnonzero(of_rows == fan) for fan in fans]
    shared, is_known = t_ns[rows[0]], known[rows[0]]
    places: list[Any] = [slice(None)] * len(fans)
    if not all(np.array_equal(t_ns[each], shared) for each in rows):
        if not known.all():
            warn([f"{NAME}: {np.count_nonzero(~known)} rows dropped: their time cannot be read"])
        shared = np.unique(t_ns[known])
        is_known = np.ones(len(shared), np.bool_)
        rows = [each[known[each]] for each in rows]
        _require_shared(found.fan, fans, [t_ns[each] for each in rows], len(shared))
        places = [np.searchsorted(shared, t_ns[each]) for each in rows]
    by_name = {"command": found.command, "speed": found.speed, **found.others}
    values: dict[tuple[str, Fan], Array] = {}
    for what, of in by_name.items():
        for name in filter(None, of.values()):
            numbers = _numbers(name, columns[name])
            for fan, of_fan, place in zip(fans, rows, places, strict=True):
                column = np.full(len(shared), np.nan)
                column[place] = numbers[of_fan]
                values[what, fan] = column
    return _Samples(shared, is_known, fans, values)


def _require_shared(column: str, fans: tuple[Fan, ...], times: list[Array], shared: int) -> None:
    """Refuse fans whose times are in disorder, or hardly ever those of the others."""
    for fan, t_ns in zip(fans, times, strict=True):
        if (np.diff(t_ns) <= 0).any():
            row = int(np.argmax(np.diff(t_ns) <= 0)) + 1
            raise FantwinError(
                f"{NAME}: the time of fan {fan} goes back or repeats at its sample {row}, and the fans have different "
                "times: sort the table and drop what is there twice"
            )
    if sum(map(len, times)) < _LEAST_SHARED * shared * len(fans):
        raise FantwinError(
            f"{NAME}: the fans of {column!r} were measured at different times; give each fan a table of its own, or "
            "resample them to common times"
        )


def _columns_and_maker(table: Any) -> tuple[dict[str, Any], Callable[[dict[str, Array], Any], Any]]:
    """The columns of a table by name, and what makes a table of the same library."""
    library = sys.modules.get(type(table).__module__.partition(".")[0])
    kind = type(table).__name__
    if library and library.__name__ == "pandas" and kind == "DataFrame":
        columns = {str(name): table[name] for name in table.columns}
        if len(columns) != table.shape[1]:
            raise FantwinError(f"{NAME} has columns of the same name")
        if table.index.dtype.kind == "M":
            columns.setdefault(str(table.index.name or "time"), table.index.to_series())
        return columns, data_frame
    if library and library.__name__ == "pyarrow" and kind == "Table":
        return {name: table.column(name) for name in table.column_names}, _arrow_table
    if isinstance(table, Mapping):
        columns = {
            str(name): np.ma.filled(np.ma.asanyarray(values), np.nan) if np.ma.isMA(values) else values
            for name, values in table.items()
        }
        lengths = {name: np.shape(values) for name, values in columns.items()}
        if len(set(lengths.values())) > 1 or any(len(shape) != 1 for shape in lengths.values()):
            shapes = ", ".join(f"{name} {shape}" for name, shape in list(lengths.items())[:_SHOWN])
            raise FantwinError(f"{NAME}: columns of different shapes, {shapes}: give each one value a row")
        return columns, lambda found, _zone: found
    raise FantwinError(
        f"a table is a pandas DataFrame, a pyarrow Table or a dict of arrays, and this is a {type(table).__name__}"
    )


def data_frame(columns: dict[str, Array], zone: Any) -> Any:
    """A DataFrame. zone: of its dates, which come in UTC."""
    pandas = sys.modules["pandas"]
    frame = pandas.DataFrame({name: _typed(values) for name, values in columns.items()})
    for name in columns if zone is not None else ():
        if columns[name].dtype.kind == "M":
            frame[name] = frame[name].dt.tz_localize("UTC").dt.tz_convert(zone)
    return frame


def _arrow_table(columns: dict[str, Array], zone: Any) -> Any:
    pyarrow = sys.modules["pyarrow"]

    def column(values: Array) -> Any:
        if values.dtype.kind == "M":
            return pyarrow.array(values, pyarrow.timestamp("ns", tz=zone))
        return pyarrow.array(_typed(values))

    return pyarrow.table({name: column(values) for name, values in columns.items()})


def _typed(values: Array) -> Array:
    """A column of no values that would be of text."""
    return values.astype(np.str_) if values.dtype == np.object_ and not len(values) else values


def _times(name: str, column: Any, ns_per_unit: int) -> tuple[Array, Array, TimesAre, Any]:
    """(n,) times in ns, whether they are known, what they are, and of which time zone."""
    values = _array(column)
    if values.dtype.kind in "Mm":
        t_ns = values.astype(f"{values.dtype.kind}8[ns]").astype(np.int64)
        return t_ns, ~np.isnat(values), "dates" if values.dtype.kind == "M" else "durations", _zone(column)
    if values.dtype.kind in "iu":
        known = np.ones(len(values), np.bool_)
        is_far = np.abs(values.astype(np.float64)) * ns_per_unit >= FURTHEST_T_NS
        t_ns = np.where(is_far, 0, values).astype(np.int64) * ns_per_unit
    else:
        numbers = _numbers(name, column)
        known = np.isfinite(numbers)
        is_far = np.abs(np.where(known, numbers, 0.0)) * ns_per_unit >= FURTHEST_T_NS
        t_ns = np.rint(np.where(known & ~is_far, numbers, 0.0) * ns_per_unit).astype(np.int64)
    if is_far.any():
        raise FantwinError(
            f'{NAME}: {values[is_far][0]} in {name!r} is beyond the year 2116: give its unit, fantwin.Columns(time="'
            f'{name}:ms"), us or ns'
        )
    return t_ns, known, "seconds", None


def _zone(column: Any) -> Any:
    """The time zone of dates of pandas, or its name of those of pyarrow; None: there is none."""
    return getattr(getattr(column, "dtype", None), "tz", None) or getattr(getattr(column, "type", None), "tz", None)


def _labels(name: str, column: Any) -> Array:
    """(n,) the fan of each row: a number or a name."""
    values = _array(column)
    if values.dtype.kind == "f" and np.array_equal(values, np.rint(values)):
        values = values.astype(np.int64)
    labels = [str(each) if isinstance(each, str) else each for each in values.tolist()]
    if not all(isinstance(each, int | str) for each in labels):
        raise FantwinError(f"{NAME}: column {name!r} must have the number or the name of a fan in each row")
    return np.array(labels, np.object_ if any(isinstance(each, str) for each in labels) else np.int64)


def _numbers(name: str, column: Any) -> Array:
    """(n,) float64, NaN where a cell is empty or infinite."""
    values = _array(column)
    if values.dtype == np.object_:
        values = np.array([np.nan if each is None or str(each) == "<NA>" else each for each in values], np.object_)
    try:
        if values.dtype.kind not in "iufO":
            raise ValueError
        numbers = values.astype(np.float64)
    except (TypeError, ValueError) as error:
        example = next(filter(_is_no_number, values.tolist()), values.dtype)
        raise FantwinError(
            f"{NAME}: column {name!r} must hold numbers, not such as {str(example)!r}; text of dates becomes dates by "
            "pandas.to_datetime"
        ) from error
    return np.where(np.isfinite(numbers), numbers, np.nan)


def _is_no_number(cell: Any) -> bool:
    try:
        float(cell)
    except (TypeError, ValueError):
        return True
    return False


def _array(column: Any) -> Array:
    """A column of any library as an array; dates with a zone in UTC."""
    if _zone(column) is not None and hasattr(column, "dt"):
        column = column.dt.tz_convert("UTC").dt.tz_localize(None)
    return np.asarray(column)
