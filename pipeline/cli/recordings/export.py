"""`fantwin export`: a recording as tables for pandas, spreadsheets and databases."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Self

import typer
from rich.console import Console

from fantwin.pipeline.cli.options import JsonOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.extras import require
from fantwin.pipeline.files import make_folder
from fantwin.pipeline.recordings.arrays import Block, read_topics
from fantwin.pipeline.recordings.export_tables import Form, TableFile, open_table
from fantwin.pipeline.recordings.left_out import left_out_hint
from fantwin.pipeline.recordings.parts import in_order
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.records import ACTIVE_SUFFIX
from fantwin.pipeline.recordings.run_recordings import run_metadata

_PART = ".part"


def export(
    recordings: Annotated[list[Path], typer.Argument(metavar="REC.mcap...", help="A recording, or its parts.")],
    to: Annotated[Form, typer.Option("--to", help="Format of the tables; parquet needs the extra `logs`.")],
    topic: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TOPIC",
            help="raw, grid, prediction, score, alarm ... Repeatable. Default: score, else raw.",
        ),
    ] = None,
    tray: Annotated[str | None, typer.Option(help="Only this tray. Default: all.")] = None,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="OUT", help="Folder, or the file of a single table."),
    ] = Path(),
    force: Annotated[bool, typer.Option("--force", help="Replace existing tables.")] = False,
    json_output: JsonOption = False,
) -> None:
    """Export a recording as tables: one per topic and tray, with a row per sample and fan.

    Exits with 3 if the recording could not be read in full; the tables then hold what could be read.

    Example: fantwin export runs/demo/recording.mcap --to csv --topic score --topic alarm -o tables
    """
    if to == "parquet":
        require("--to parquet (--to csv does not)", "logs", "pyarrow")
    parts = in_order(recordings)
    topics = list(dict.fromkeys(topic or _default_topics(parts)))
    arrays = read_topics(parts, topics, tray)
    with (
        Console(stderr=True).status(f"exporting {parts[0]}") as status,
        _Tables(parts, to, output, replace=force) as tables,
    ):
        for block in arrays:
            tables.add(block)
            status.update(f"exporting {parts[0]}: {tables.rows} rows")
        if not tables.begun:
            raise UserError(_no_messages(parts, topics, tray, arrays.damage))
        tables.finish("; ".join(arrays.damage))
    written = [table.summary() for table in tables.begun.values()]
    absent = [name for name in topics if name not in {table["topic"] for table in written}]
    found = {"tables": written, "absent": absent, "duplicated": arrays.duplicated, "damage": arrays.damage}
    show(found, *(f"{table['file']}: {table['rows']} rows" for table in written), json_output=json_output)
    for name in absent:
        typer.echo(": ".join(filter(None, (f"no {name} in this recording", left_out_hint(parts, (name,))))), err=True)
    for line in arrays.damage:
        typer.echo(line, err=True)
    if arrays.damage:
        raise typer.Exit(3)


@dataclass(frozen=True)
class _Table:
    """A table that is being written, under a temporary name until all tables are complete."""

    site: str
    tray: str
    topic: str
    path: Path
    file: TableFile

    def belongs_to(self, block: Block) -> bool:
        return (self.site, self.tray, self.topic) == (block.site, block.tray, block.topic)

    def summary(self) -> dict[str, Any]:
        return {"file": str(self.path), "topic": self.topic, "tray": self.tray, "rows": self.file.rows}


class _Tables:
    """The tables of an export. Each is created with its first rows; without `finish` all are removed again."""

    def __init__(self, parts: Sequence[Path], form: Form, output: Path, *, replace: bool) -> None:
        """`output` is a folder, or one file if its suffix says so. Raises UserError if it cannot be used."""
        if output.suffix in (".csv", ".parquet") and output.suffix != f".{form}":
            raise UsageError(f"{output}: name a file that ends in .{form} with -o, or a folder")
        self.begun: dict[Path, _Table] = {}
        self._metadata = run_metadata(parts)
        self._stem = parts[0].name.removesuffix(ACTIVE_SUFFIX).removesuffix(".mcap")
        self._form: Form = form
        self._output = output
        self._is_file = output.suffix == f".{form}"
        self._replace = replace
        make_folder(output.parent if self._is_file else output)

    @property
    def rows(self) -> int:
        return sum(table.file.rows for table in self.begun.values())

    def add(self, block: Block) -> None:
        """Append a block to its table.

        Raises:
            UserError: the table cannot be written, exists already, or would be the second one in a single file.
        """
        path = self._path(block)
        try:
            if path not in self.begun:
                self._begin(path, block)
            table = self.begun[path]
            if not table.belongs_to(block):
                one, other = (_printable(each.tray or each.site) for each in (table, block))
                raise UserError(
                    f"{path}: would hold both {table.topic} of {one} and {block.topic} of {other}: name a folder with "
                    "-o, or choose with --topic and --tray"
                )
            table.file.add(block)
        except OSError as error:
            raise _cannot_write(path, error) from error

    def finish(self, damage: str) -> None:
        """Complete all tables and give them their names. Raises UserError if one cannot be written."""
        for path, table in self.begun.items():
            try:
                table.file.close(damage)
                _unfinished(path).replace(path)
            except OSError as error:
                raise _cannot_write(path, error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for table in self.begun.values():
            with suppress(OSError):  # a full disk refuses the buffered rest as well
                table.file.close()
            _unfinished(table.path).unlink(missing_ok=True)

    def _path(self, block: Block) -> Path:
        if self._is_file:
            return self._output
        name = ".".join(part for part in (self._stem, _printable(block.tray), block.topic, self._form) if part)
        return self._output / name

    def _begin(self, path: Path, block: Block) -> None:
        if path.exists() and not self._replace:
            raise UserError(f"{path}: exists; name another folder or file with -o, or replace it with --force")
        about = {
            **self._metadata.metadata,
            "topic": block.topic,
            "tray": block.tray,
            "speed_unit": self._metadata.speed_unit(block.tray),
            "exported_by": f"fantwin {version('fantwin')}",
        }
        file = open_table(self._form, _unfinished(path), block.topic, about)
        self.begun[path] = _Table(block.site, block.tray, block.topic, path, file)


def _printable(name: str) -> str:
    """A tray's name as part of a file's: a recording from elsewhere may name it anything."""
    return "".join(each if each.isprintable() else "_" for each in name)


def _cannot_write(path: Path, error: OSError) -> UserError:
    reason = os.strerror(error.errno) if error.errno else str(error)  # the text of Arrow is long
    return UserError(f"{path}: cannot be written: {reason}; name another folder with -o")


def _unfinished(path: Path) -> Path:
    return path.with_name(path.name + _PART)


def _default_topics(parts: Sequence[Path]) -> tuple[str]:
    has_scores = any(True for part in parts for _ in read_recording(part, topics=("score",)))
    return ("score",) if has_scores else ("raw",)


def _no_messages(parts: Sequence[Path], topics: Sequence[str], tray: str | None, damage: Sequence[str]) -> str:
    of_tray = f" of a tray {tray!r}" if tray else ""
    lost = f" ({'; '.join(damage)})" if damage else ""
    todo = left_out_hint(parts, topics) or "see --topic and --tray"
    return f"{parts[0]}: no {' or '.join(topics)}{of_tray} in this recording{lost}; {todo}"
