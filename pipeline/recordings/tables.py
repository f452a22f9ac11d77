"""Blocks of a recording as tables for other programs: a row for each sample and fan, in a CSV or a Parquet file.

A table is written in pieces, so what is in memory does not grow with it. Codes become words, and what is not there (NaN
in the messages) is empty. See docs/how-to/read-recordings.md.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np

from pipeline.recordings.arrays import WORDS, Block, block_columns
from schemas.messages import Array, Message
from schemas.topics import BY_NAME

Form: TypeAlias = Literal["csv", "parquet"]
PIECE_ROWS = 65_536

_WORDS = {name: np.array([code.name for code in codes], np.object_) for name, codes in WORDS.items()}


class TableFile(Protocol):
    """A file that takes the blocks of one topic, one after the other."""

    rows: int

    def add(self, block: Block) -> None: ...  # noqa: D102
    def close(self, damage: str = "") -> None: ...  # noqa: D102


def open_table(form: Form, path: Path, topic: str, about: Mapping[str, str]) -> TableFile:
    """Begin a table.

    Args:
        form: `parquet` needs the extra of that name.
        path: is overwritten.
        topic: of its blocks.
        about: what the table is of; kept where the form has room for it.

    Raises:
        OSError: it cannot be written.
    """
    message_type = BY_NAME[topic].message
    return CsvTable(path, message_type) if form == "csv" else ParquetTable(path, message_type, about)


def table_columns(message_type: type[Message]) -> dict[str, np.dtype[Any]]:
    """The columns of a topic's table by name, the time first; those of `WORDS` are words in the file."""
    found = block_columns(message_type)
    kinds = {name: column.dtype for name, column in found.items()}
    time = next(iter(kinds))
    fan = {"fan": np.dtype(np.int64)} if any(column.by_fan for column in found.values()) else {}
    return {time: kinds[time]} | fan | kinds


class CsvTable:
    """Comma-separated text with a line of names."""

    def __init__(self, path: Path, message_type: type[Message]) -> None:
        self.rows = 0
        self._columns = table_columns(message_type)
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(self._columns)

    def add(self, block: Block) -> None:
        """Append a block's rows."""
        for rows, piece in _pieces(block):
            self._writer.writerows(zip(*(_texts(name, piece[name], rows) for name in self._columns), strict=True))
            self.rows += rows

    def close(self, damage: str = "") -> None:
        """End the file."""
        self._file.close()


class ParquetTable:
    """Parquet, with `time`, a timestamp in UTC, before all other columns."""

    def __init__(self, path: Path, message_type: type[Message], about: Mapping[str, str]) -> None:
        import pyarrow as pa  # noqa: PLC0415  the extra `parquet` may not be installed
        from pyarrow.parquet import ParquetWriter  # noqa: PLC0415

        self.rows = 0
        kinds = table_columns(message_type)
        self._time = next(iter(kinds))
        types = {"time": pa.timestamp("ns", tz="UTC")} | {name: _arrow_type(name, kinds[name]) for name in kinds}
        self._schema = pa.schema(list(types.items()), {f"fantwin.{name}": said for name, said in about.items()})
        self._writer = ParquetWriter(path, self._schema, compression="zstd")

    def add(self, block: Block) -> None:
        """Append a block's rows."""
        import pyarrow as pa  # noqa: PLC0415

        for rows, piece in _pieces(block):
            values = {"time": piece[self._time]} | piece
            arrays = [_arrow(field.name, values[field.name], rows, field.type) for field in self._schema]
            self._writer.write_table(pa.Table.from_arrays(arrays, schema=self._schema))
            self.rows += rows

    def close(self, damage: str = "") -> None:
        """End the file. damage: what could not be read of the recording, kept in the table's metadata."""
        if damage:
            self._writer.add_key_value_metadata({"fantwin.damage": damage})
        self._writer.close()


def _pieces(block: Block) -> Iterator[tuple[int, dict[str, Array]]]:
    """A block with a row for each sample and fan, in pieces: their rows, their columns. A column that the device does
    not have is empty."""
    kinds = block_columns(BY_NAME[block.topic].message)
    wide = max(1, block.fans)  # what is said of no fan (a twin without any) is a row all the same
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


def _texts(name: str, values: Array, rows: int) -> list[Any]:
    """The values of a column as the CSV writer wants them."""
    if not values.size:
        return [""] * rows
    if name in WORDS:
        return _WORDS[name][values].tolist()
    if values.dtype == np.bool_:
        return np.where(values, "true", "false").tolist()
    if values.dtype == np.float64:
        return np.where(np.isnan(values), "", values.astype(np.object_)).tolist()
    return values.tolist()


def _arrow_type(name: str, dtype: np.dtype[Any]) -> Any:
    import pyarrow as pa  # noqa: PLC0415

    if name in WORDS:
        return pa.dictionary(pa.int8(), pa.string())
    return pa.string() if dtype == np.object_ else pa.from_numpy_dtype(dtype)


def _arrow(name: str, values: Array, rows: int, type_: Any) -> Any:
    import pyarrow as pa  # noqa: PLC0415

    if not values.size:
        return pa.nulls(rows, type_)
    if name in WORDS:
        return pa.DictionaryArray.from_arrays(pa.array(values.astype(np.int8)), pa.array(_WORDS[name]))
    return pa.array(values, type_, from_pandas=True)
