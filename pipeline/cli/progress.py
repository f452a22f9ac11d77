"""Progress of commands: bars on a terminal, a plain line every few seconds elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from pipeline.cli.twins.training_data import TrainingData
    from twin.fitting.training import Progress as ProgressCallback

LINE_PERIOD_S = 5.0


@contextmanager
def working(title: str) -> Iterator[Callable[[str], None]]:
    """Around work of unknown length; yields a function that shows which part is being done."""
    console = Console(stderr=True)
    if not console.is_terminal:
        typer.echo(title, err=True)
        yield lambda part: typer.echo(part, err=True)
        return
    with console.status(title) as status:
        yield status.update


@contextmanager
def training_progress(training_data: TrainingData) -> Iterator[Callable[[str], ProgressCallback]]:
    """Around trainings; yields a function that starts the display of one by its name and returns its progress callback.

    Bars disappear at the end. Lines appear when a training begins and every LINE_PERIOD_S.
    """
    console = Console(stderr=True)

    def error(rmse_rad_s: float) -> str:
        return f"free-run rmse {rmse_rad_s / training_data.rad_s_per_unit:.4g} {training_data.speed_unit}"

    def start_lines(name: str) -> ProgressCallback:
        prefix = f"{name}: " if name else ""
        typer.echo(f"{prefix}identifying", err=True)
        started_s = shown_s = time.monotonic()

        def show(done: int, at_most: int, rmse_rad_s: float) -> None:
            nonlocal shown_s
            now_s = time.monotonic()
            if now_s - shown_s >= LINE_PERIOD_S:
                shown_s = now_s
                typer.echo(f"{prefix}{done}/{at_most}, {error(rmse_rad_s)}, {now_s - started_s:.0f} s", err=True)

        return show

    if not console.is_terminal:
        yield start_lines
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as bars:

        def start_bar(name: str) -> ProgressCallback:
            prefix = f"{name}: " if name else ""
            task = bars.add_task(f"{prefix}identifying", total=None)

            def show(done: int, at_most: int, rmse_rad_s: float) -> None:
                bars.update(task, completed=done, total=at_most, description=prefix + error(rmse_rad_s))

            return show

        yield start_bar
