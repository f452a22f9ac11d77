"""What commands show while they work: something that moves on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from pipeline.cli.twins.training_data import Material
    from twin.fitting.training import Progress as ProgressCallback

A_LINE_EVERY_S = 5.0


@contextmanager
def working(said: str) -> Iterator[Callable[[str], None]]:
    """Around work that cannot tell how far it is; gives what says which part of it is being done."""
    console = Console(stderr=True)
    if not console.is_terminal:
        typer.echo(said, err=True)
        yield lambda part: typer.echo(part, err=True)
        return
    with console.status(said) as status:
        yield status.update


@contextmanager
def training_progress(material: Material) -> Iterator[Callable[[str], ProgressCallback]]:
    """Gives what shows the progress of each training, by the name it is given: bars that go when all is done, or lines.

    A line tells when a training begins, and every few seconds how far it is.
    """
    console = Console(stderr=True)

    def error(rmse_rad_s: float) -> str:
        return f"free-run rmse {rmse_rad_s / material.rad_s_per_unit:.4g} {material.speed_unit}"

    def start_lines(name: str) -> ProgressCallback:
        said = f"{name}: " if name else ""
        typer.echo(f"{said}identifying", err=True)
        started_s = told_s = time.monotonic()

        def tell(done: int, at_most: int, rmse_rad_s: float) -> None:
            nonlocal told_s
            now_s = time.monotonic()
            if now_s - told_s >= A_LINE_EVERY_S:
                told_s = now_s
                typer.echo(f"{said}{done}/{at_most}, {error(rmse_rad_s)}, {now_s - started_s:.0f} s", err=True)

        return tell

    if not console.is_terminal:
        yield start_lines
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as bars:

        def start_bar(name: str) -> ProgressCallback:
            said = f"{name}: " if name else ""
            task = bars.add_task(f"{said}identifying", total=None)

            def show(done: int, at_most: int, rmse_rad_s: float) -> None:
                bars.update(task, completed=done, total=at_most, description=said + error(rmse_rad_s))

            return show

        yield start_bar
