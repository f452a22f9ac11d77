"""A preview of an import as people and machines read it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.sources.preview import Preview, PreviewColumn


def show_previews(previews: Sequence[Preview], *, json_output: bool) -> None:
    """Print what was understood of each file, and the command line that imports it."""
    found = [asdict(each) | {"path": str(each.path), "command_line": each.command_line} for each in previews]
    show({"files": found}, *(line for each in previews for line in _lines(each)), json_output=json_output)


def _lines(preview: Preview) -> list[str]:
    width = max((len(each.name) for each in preview.columns), default=0)
    return [
        f"{preview.path}: {preview.understood[0]}",
        *(f"  {line}" for line in preview.understood[1:]),
        *(_column(each, width) for each in preview.columns),
        *(f"  {each.label}: command {each.command}, speed {each.speed}" for each in preview.fans),
        *(f"  {note}" for note in preview.notes),
        f"to import it: {preview.command_line}",
    ]


def _column(column: PreviewColumn, width: int) -> str:
    span = "no numbers" if column.lowest is None else f"{column.lowest:10.6g} to {column.highest:.6g}"
    rate = f"  {column.rate_hz:8.3g} Hz" if column.rate_hz else ""
    ends = " ".join(filter(None, (span, column.unit)))
    return f"{column.name:{width}}  {column.values:7d} values{rate}  {ends}{f'  {column.note}' if column.note else ''}"
