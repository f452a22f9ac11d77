"""Blocks of a recording as tables for other programs: CSV or Parquet, one row per sample and fan.

A table is written in pieces, so memory does not grow with it. Enum values become their names, and missing values (NaN
in the messages) become empty cells. See docs/how-to/read-recordings.md.
"""

from __future__ import annotations

import csv
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from fantwin.pipeline.recordings.arrays import Block, BlockColumn, block_columns, enum_names
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.fields import Array
from fantwin.schemas.messages import Message
from fantwin.schemas.topics import BY_NAME

Form: TypeAlias = Literal["csv", "parquet"]
PIECE_ROWS = 65_536


def open_table(form: Form, path: Path, topic: str, about: Mapping[str, str], names: FanNames = NO_NAMES) -> TableFile:
    """Create a table file.

    Args:
        form: `parquet` needs the extra of that name.
        path: overwritten if it exists.
        topic: topic of the blocks.
        about: metadata of the table; kept by Parquet, dropped by CSV.
        names: of the fans of the tray.

    Raises:
        OSError: the file cannot be written.
    """
    message_type = BY_NAME[topic].message
    return CsvTable(path, message_type, names) if form == "csv" else ParquetTable(path, message_type, names, about)


def table_columns(message_type: type[Message]) -> dict[str, BlockColumn]:
    """The columns of a topic's table by name, the time first. Enum columns are written as names."""
    found = block_columns(message_type)
    time = next(iter(found))
    fan = {"fan": BlockColumn(np.dtype(np.int64)), "fan_name": BlockColumn(np.dtype(np.object_))}
    return {time: found[time], **(fan if any(column.by_fan for column in found.values()) else {}), **found}


class TableFile(ABC):
    """A file that is written block by block, for one topic."""

    def __init__(self, message_type: type[Message], names: FanNames) -> None:
        self.rows, self._names = 0, names
        self._columns = table_columns(message_type)

    def add(self, block: Block) -> None:
        """Append a block's rows."""
        for rows, piece in _pieces(block, self._names):
            self._write(rows, piece)
            self.rows += rows

    @abstractmethod
    def _write(self, rows: int, piece: Mapping[str, Array]) -> None: ...

    @abstractmethod
    def close(self, damage: str = "") -> None:
        """End the file. damage: what could not be read of the recording; kept where the table has metadata."""


class CsvTable(TableFile):
    """Comma-separated text with a header line."""

    def __init__(self, path: Path, message_type: type[Message], names: FanNames) -> None:
        super().__init__(message_type, names)
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(self._columns)

    def _write(self, rows: int, piece: Mapping[str, Array]) -> None:
        self._writer.writerows(zip(*(_texts(piece[name], rows) for name in self._columns), strict=True))

    def close(self, damage: str = "") -> None:
        """End the file."""
        self._file.close()


class ParquetTable(TableFile):
    """Parquet, with `time`, a timestamp in UTC, before all other columns."""

    def __init__(self, path: Path, message_type: type[Message], names: FanNames, about: Mapping[str, str]) -> None:
        import pyarrow as pa  # noqa: PLC0415  the extra `logs` may not be installed
        from pyarrow.parquet import ParquetWriter  # noqa: PLC0415

        super().__init__(message_type, names)
        self._time = next(iter(self._columns))
        types = {"time": pa.timestamp("ns", tz="UTC")}
        types |= {name: _arrow_type(column) for name, column in self._columns.items()}
        self._schema = pa.schema(list(types.items()), {f"fantwin.{name}": value for name, value in about.items()})
        self._writer = ParquetWriter(path, self._schema, compression="zstd")

    def _write(self, rows: int, piece: Mapping[str, Array]) -> None:
        import pyarrow as pa  # noqa: PLC0415

        columns = {"time": piece[self._time], **{name: piece[name] for name in self._columns}}
        arrays = [
            pa.array(values, self._schema.field(name).type, from_pandas=True)
            if values.size
            else pa.nulls(rows, self._schema.field(name).type)
            for name, values in columns.items()
        ]
        self._writer.write_table(pa.Table.from_arrays(arrays, schema=self._schema))

    def close(self, damage: str = "") -> None:
        """End the file, and keep `damage` in its metadata."""
        if damage:
            self._writer.add_key_value_metadata({"fantwin.damage": damage})
        self._writer.close()


def _pieces(block: Block, names: FanNames) -> Iterator[tuple[int, dict[str, Array]]]:
    """Split a block into pieces with one row per sample and fan: (rows, columns by name).

    Enum values become their names. A column that the device does not have stays empty.
    """
    kinds = block_columns(BY_NAME[block.topic].message)
    wide = max(1, block.fans)  # a message without fans (a twin that lists none) is one row
    step = max(1, PIECE_ROWS // wide)
    fan_names = np.array([names.name(fan) for fan in range(block.fans)], np.object_)
    for first in range(0, len(block), step):
        part = {name: values[first : first + step] for name, values in block.columns.items()}
        part |= {name: enum_names(enum)[values] for name, values in part.items() if (enum := kinds[name].enum)}
        samples = min(step, len(block) - first)
        yield (
            samples * wide,
            {"fan": np.tile(np.arange(block.fans), samples), "fan_name": np.tile(fan_names, samples)}
            | {
                name: values.reshape(-1) if kinds[name].by_fan else np.repeat(values, wide)
                for name, values in part.items()
            },
        )


def _texts(values: Array, rows: int) -> list[Any]:
    """The values of a column for the CSV writer."""
    if not values.size:
        return [""] * rows
    if values.dtype == np.bool_:
        return np.where(values, "true", "false").tolist()
    if values.dtype.kind == "f":  # a float32 as text, with the digits that it has
        shown = values.astype(np.object_ if values.dtype == np.float64 else np.str_)
        return np.where(np.isnan(values), "", shown).tolist()
    return values.tolist()


def _arrow_type(column: BlockColumn) -> Any:
    import pyarrow as pa  # noqa: PLC0415

    if column.enum:
        return pa.dictionary(pa.int8(), pa.string())
    return pa.string() if column.dtype == np.object_ else pa.from_numpy_dtype(column.dtype)
