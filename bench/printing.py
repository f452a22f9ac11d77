"""How the benches print: a table for people, or the same rows as JSON for machines."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, TypeAlias

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

JsonOption: TypeAlias = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
Row: TypeAlias = Mapping[str, Any]

WIDTH = 130


def show(tables: Mapping[str, Sequence[Row]], notes: Sequence[str], *, as_json: bool) -> None:
    """Print tables (title: rows, all of the same keys) and notes below them."""
    if as_json:
        print(json.dumps({**tables, "notes": list(notes)}, indent=1, default=_plain))
        return
    console = Console(width=WIDTH)
    for title, rows in tables.items():
        console.print(_table(title, rows))
    for note in notes:
        console.print(f"- {note}", highlight=False, markup=False)


def progress(text: str) -> None:
    """One line to stderr about what runs now."""
    Console(stderr=True).print(text, style="dim", highlight=False, markup=False)


def _table(title: str, rows: Sequence[Row]) -> Table:
    table = Table(title=escape(title), title_justify="left")
    for name in rows[0]:
        numbers = all(not isinstance(row[name], str) for row in rows)
        table.add_column(escape(name), justify="right" if numbers else "left", no_wrap=not numbers)
    for row in rows:
        table.add_row(*(escape(_cell(value)) for value in row.values()))
    return table


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, float):
        return "diverges" if math.isinf(value) else f"{value:.4g}" if abs(value) < 1e4 else f"{value:,.0f}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _plain(value: Any) -> Any:
    return value.item()
