"""`fantwin export`: a recording as tables for pandas, spreadsheets and databases."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from fantwin.pipeline.cli.options import JsonOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.extras import require
from fantwin.pipeline.files import temporary_folder
from fantwin.pipeline.recordings.arrays import Block, read_topics
from fantwin.pipeline.recordings.export_tables import Form, TableFile, open_table
from fantwin.pipeline.recordings.left_out import left_out_hint
from fantwin.pipeline.recordings.parts import in_order
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.records import ACTIVE_SUFFIX
from fantwin.pipeline.recordings.run_recordings import run_metadata


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
    if output.suffix in (".csv", ".parquet") and not _is_file(output, to):
        raise UsageError(f"{output}: name a file that ends in .{to} with -o, or a folder")
    arrays = read_topics(parts, topics, tray)
    with (
        Console(stderr=True).status(f"exporting {parts[0]}") as status,
        temporary_folder(output.parent if _is_file(output, to) else output) as folder,
        closing(_Tables(parts, to, output, folder, replace=force)) as tables,
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
    """A table that is being written: of which site, tray and topic, where it will be, and its file until then."""

    of: tuple[str, str, str]
    path: Path
    file: TableFile

    def summary(self) -> dict[str, Any]:
        _, tray, topic = self.of
        return {"file": str(self.path), "topic": topic, "tray": tray, "rows": self.file.rows}


class _Tables:
    """The tables of an export. Each is created with its first rows, in a folder of its own until all are complete."""

    def __init__(self, parts: Sequence[Path], form: Form, output: Path, folder: Path, *, replace: bool) -> None:
        """output: a folder, or one file if its suffix says so. folder: of tables that are not complete yet."""
        self.begun: dict[Path, _Table] = {}
        self._metadata = run_metadata(parts)
        self._stem = parts[0].name.removesuffix(ACTIVE_SUFFIX).removesuffix(".mcap")
        self._form: Form = form
        self._output, self._folder, self._replace = output, folder, replace

    @property
    def rows(self) -> int:
        return sum(table.file.rows for table in self.begun.values())

    def add(self, block: Block) -> None:
        """Append a block to its table.

        Raises:
            UserError: the table cannot be written, exists already, or would be the second one in a single file.
        """
        of = block.site, block.tray, block.topic
        name = ".".join(part for part in (self._stem, _printable(block.tray), block.topic, self._form) if part)
        path = self._output if _is_file(self._output, self._form) else self._output / name
        try:
            table = self.begun.get(path) or self._begin(path, block, of)
            if table.of != of:
                one, other = (f"{topic} of {_printable(tray or site)}" for site, tray, topic in (table.of, of))
                raise UserError(
                    f"{path}: would hold both {one} and {other}: name a folder with -o, or choose with --topic and "
                    "--tray"
                )
            table.file.add(block)
        except OSError as error:
            raise _cannot_write(path, error) from error

    def finish(self, damage: str) -> None:
        """Complete all tables and give them their names. Raises UserError if one cannot be written."""
        for path, table in self.begun.items():
            try:
                table.file.close(damage)
                (self._folder / path.name).replace(path)
            except OSError as error:
                raise _cannot_write(path, error) from error

    def close(self) -> None:
        """Close the files of tables that are not complete."""
        for table in self.begun.values():
            with suppress(OSError):  # a full disk refuses the buffered rest as well
                table.file.close()

    def _begin(self, path: Path, block: Block, of: tuple[str, str, str]) -> _Table:
        if path.exists() and not self._replace:
            raise UserError(f"{path}: exists; name another folder or file with -o, or replace it with --force")
        about = {
            **self._metadata.metadata,
            "topic": block.topic,
            "tray": block.tray,
            "speed_unit": self._metadata.speed_unit(block.tray),
            "exported_by": f"fantwin {version('fantwin')}",
        }
        file = open_table(self._form, self._folder / path.name, block.topic, about, self._metadata.names(block.tray))
        self.begun[path] = _Table(of, path, file)
        return self.begun[path]


def _printable(name: str) -> str:
    """A tray's name as part of a file's: a recording from elsewhere may name it anything."""
    return "".join(each if each.isprintable() else "_" for each in name)


def _cannot_write(path: Path, error: OSError) -> UserError:
    reason = os.strerror(error.errno) if error.errno else str(error)  # the text of Arrow is long
    return UserError(f"{path}: cannot be written: {reason}; name another folder with -o")


def _is_file(output: Path, form: Form) -> bool:
    return output.suffix == f".{form}"


def _default_topics(parts: Sequence[Path]) -> tuple[str]:
    has_scores = any(True for part in parts for _ in read_recording(part, topics=("score",)))
    return ("score",) if has_scores else ("raw",)


def _no_messages(parts: Sequence[Path], topics: Sequence[str], tray: str | None, damage: Sequence[str]) -> str:
    of_tray = f" of a tray {tray!r}" if tray else ""
    lost = f" ({'; '.join(damage)})" if damage else ""
    todo = left_out_hint(parts, topics) or "see --topic and --tray"
    return f"{parts[0]}: no {' or '.join(topics)}{of_tray} in this recording{lost}; {todo}"
