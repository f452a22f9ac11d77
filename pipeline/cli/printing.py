"""What commands print: JSON for machines with --json, lines and tables for people."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import typer

from fantwin.schemas.enums import Severity

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import RenderableType
    from rich.table import Table

STYLES = {Severity.NONE: "", Severity.WARNING: "yellow", Severity.ALARM: "bold red"}
"""of an alarm, by its severity"""


def show(found: Any, *lines: RenderableType, json_output: bool) -> None:
    """Print a result. found: its JSON fields. lines: the same for people."""
    if json_output:
        typer.echo(json.dumps(found))
        return
    for line in lines:
        if isinstance(line, str):
            typer.echo(line)
        else:
            _print(line)


def _print(what: RenderableType) -> None:
    from rich.console import Console  # noqa: PLC0415  the process of a stage needs no rich

    Console(soft_wrap=True, highlight=False).print(what)


def table_of(left: Sequence[str], right: Sequence[str] = (), more: Sequence[str] = (), **options: Any) -> Table:
    """An empty table: names to the left and numbers to the right, which are never cut, and texts that are wrapped.

    options: of `rich.table.Table`.
    """
    from rich.box import SIMPLE_HEAD  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    options = {
        "box": SIMPLE_HEAD,
        "padding": (0, 1, 0, 0),
        "title_justify": "left",
        "caption_justify": "left",
    } | options
    table = Table(**options)
    for name in left:
        table.add_column(name, no_wrap=True)
    for name in right:
        table.add_column(name, no_wrap=True, justify="right")
    for name in more:
        table.add_column(name)
    return table


def duration_text(seconds: float) -> str:
    """A length of time to two digits or so: 0.4 s, 45 s, 12 min, 5 h, 3 d."""
    units = (("d", 86_400.0), ("h", 3600.0), ("min", 60.0))
    below_minutes = f"{seconds:.0f} s" if seconds >= 10.0 else f"{seconds:.1f} s"
    return next((f"{seconds / size:.0f} {unit}" for unit, size in units if seconds >= 2 * size), below_minutes)
