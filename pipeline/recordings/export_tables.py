"""Blocks of a recording as tables for other programs: CSV or Parquet, one row per sample and fan.

A table is written in pieces, so memory does not grow with it. Enum values become their names, and missing values (NaN
in the messages) become empty cells. See docs/how-to/read-recordings.md.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np

from fantwin.pipeline.recordings.arrays import Block, BlockColumn, block_columns, enum_names
from fantwin.schemas.fields import Array, OpenEnum
from fantwin.schemas.messages import Message
from fantwin.schemas.topics import BY_NAME

Form: TypeAlias = Literal["csv", "parquet"]
PIECE_ROWS = 65_536


class TableFile(Protocol):
    """A file that is written block by block, for one topic."""

    rows: int

    def add(self, block: Block) -> None: ...  # noqa: D102
    def close(self, damage: str = "") -> None: ...  # noqa: D102


def open_table(form: Form, path: Path, topic: str, about: Mapping[str, str]) -> TableFile:
    """Create a table file.

    Args:
        form: `parquet` needs the extra of that name.
        path: overwritten if it exists.
        topic: topic of the blocks.
        about: metadata of the table; kept by Parquet, dropped by CSV.

    Raises:
        OSError: the file cannot be written.
    """
    message_type = BY_NAME[topic].message
    return CsvTable(path, message_type) if form == "csv" else ParquetTable(path, message_type, about)


def table_columns(message_type: type[Message]) -> dict[str, BlockColumn]:
    """The columns of a topic's table by name, the time first. Enum columns are written as names."""
    found = block_columns(message_type)
    time = next(iter(found))
    fan = {"fan": BlockColumn(np.dtype(np.int64))} if any(column.by_fan for column in found.values()) else {}
    return {time: found[time], **fan, **found}


class CsvTable:
    """Comma-separated text with a header line."""

    def __init__(self, path: Path, message_type: type[Message]) -> None:
        self.rows = 0
        self._columns = table_columns(message_type)
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(self._columns)

    def add(self, block: Block) -> None:
        """Append a block's rows."""
        for rows, piece in _pieces(block):
            texts = (_texts(column.enum, piece[name], rows) for name, column in self._columns.items())
            self._writer.writerows(zip(*texts, strict=True))
            self.rows += rows

    def close(self, damage: str = "") -> None:
        """End the file."""
        self._file.close()


class ParquetTable:
    """Parquet, with `time`, a timestamp in UTC, before all other columns."""

    def __init__(self, path: Path, message_type: type[Message], about: Mapping[str, str]) -> None:
        import pyarrow as pa  # noqa: PLC0415  the extra `logs` may not be installed
        from pyarrow.parquet import ParquetWriter  # noqa: PLC0415

        self.rows = 0
        self._columns = table_columns(message_type)
        self._time = next(iter(self._columns))
        types = {"time": pa.timestamp("ns", tz="UTC")}
        types |= {name: _arrow_type(column) for name, column in self._columns.items()}
        self._schema = pa.schema(list(types.items()), {f"fantwin.{name}": value for name, value in about.items()})
        self._writer = ParquetWriter(path, self._schema, compression="zstd")

    def add(self, block: Block) -> None:
        """Append a block's rows."""
        import pyarrow as pa  # noqa: PLC0415

        for rows, piece in _pieces(block):
            arrays = [pa.array(piece[self._time], self._schema.field("time").type)]
            for name, column in self._columns.items():
                arrays.append(_arrow(column.enum, piece[name], rows, self._schema.field(name).type))
            self._writer.write_table(pa.Table.from_arrays(arrays, schema=self._schema))
            self.rows += rows

    def close(self, damage: str = "") -> None:
        """End the file. damage: what could not be read of the recording; kept in the table's metadata."""
        if damage:
            self._writer.add_key_value_metadata({"fantwin.damage": damage})
        self._writer.close()


def _pieces(block: Block) -> Iterator[tuple[int, dict[str, Array]]]:
    """Split a block into pieces with one row per sample and fan: (rows, columns by name).

    A column that the device does not have stays empty.
    """
    kinds = block_columns(BY_NAME[block.topic].message)
    wide = max(1, block.fans)  # a message without fans (a twin that lists none) is one row
    step = max(1, PIECE_ROWS // wide)
    for first in range(0, len(block), step):
        part = {name: values[first : first + step] for name, values in block.columns.items()}
        samples = min(step, len(block) - first)
        yield (
            samples * wide,
            {"fan": np.tile(np.arange(block.fans), samples)}
            | {
                name: values.reshape(-1) if kinds[name].by_fan else np.repeat(values, wide)
                for name, values in part.items()
            },
        )


def _texts(enum: type[OpenEnum] | None, values: Array, rows: int) -> list[Any]:
    """The values of a column for the CSV writer."""
    if not values.size:
        return [""] * rows
    if enum:
        return enum_names(enum)[values].tolist()
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


def _arrow(enum: type[OpenEnum] | None, values: Array, rows: int, type_: Any) -> Any:
    import pyarrow as pa  # noqa: PLC0415

    if not values.size:
        return pa.nulls(rows, type_)
    if enum:
        # The categories are all known names, and the unknown numbers that occur.
        present = np.union1d([int(value) for value in enum], values)
        categories = enum_names(enum)[present]
        codes = np.searchsorted(present, values).astype(np.int8)
        return pa.DictionaryArray.from_arrays(pa.array(codes), pa.array(categories))
    return pa.array(values, type_, from_pandas=True)
