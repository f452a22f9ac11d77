"""Progress of commands: bars on a terminal, a plain line every few seconds elsewhere."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from fantwin.pipeline.cli.twins.training_data import TrainingData
    from fantwin.twin.progress import Progress as ProgressCallback

LINE_PERIOD_S = 5.0
EXIT_INTERRUPTED = 130
"""as of a program that SIGINT ends"""
_SHOW_PART: ContextVar[Callable[[str], None] | None] = ContextVar("show_part", default=None)


@contextmanager
def interruptible(outcome: str) -> Iterator[None]:
    """Around work whose result is written at its end: Ctrl-C ends the command with one line, which says the outcome.

    So does SIGTERM, so that temporary files are removed: they may be as large as recordings.
    """
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except KeyboardInterrupt:
        typer.echo(f"interrupted: {outcome}", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    finally:
        signal.signal(signal.SIGTERM, before)


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
def recordings_progress(doing: str, count: int) -> Iterator[Callable[[], None]]:
    """Around work on so many recordings: one bar. Yields a function that says that one more is done.

    Without a terminal, lines appear every LINE_PERIOD_S. Inside, `show_part` shows what is being done.
    """
    console = Console(stderr=True)
    done = 0
    shown_s = time.monotonic()

    def line(part: str = "") -> None:
        nonlocal shown_s
        if time.monotonic() - shown_s >= LINE_PERIOD_S:
            shown_s = time.monotonic()
            typer.echo(f"{doing}: {done}/{count}{f', {part}' if part else ''}", err=True)

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        bar = bars.add_task(doing, total=count)

        def show(part: str) -> None:
            bars.update(bar, description=f"{doing}: {part}")
            if not console.is_terminal:
                line(part)

        def advance() -> None:
            nonlocal done
            done += 1
            bars.update(bar, completed=done, description=doing)
            if not console.is_terminal:
                line()

        token = _SHOW_PART.set(show)
        try:
            yield advance
        finally:
            _SHOW_PART.reset(token)


def show_part(part: str) -> None:
    """Show which part of a recording is being done; nothing where the work is done in another process."""
    if show := _SHOW_PART.get():
        show(part)


@contextmanager
def training_progress(training_data: TrainingData) -> Iterator[Callable[[str], ProgressCallback]]:
    """Around identification and training; yields a function that starts the display of one by its name and returns its
    progress callback.

    Bars disappear at the end. Lines appear when a part of the work begins and every LINE_PERIOD_S.
    """
    console = Console(stderr=True)

    def error(rmse_rad_s: float) -> str:
        if math.isnan(rmse_rad_s):
            return ""
        return f", free-run rmse {rmse_rad_s / training_data.rad_s_per_unit:.4g} {training_data.speed_unit}"

    def start_lines(name: str) -> ProgressCallback:
        prefix = f"{name}: " if name else ""
        started_s, shown_s, shown_part = time.monotonic(), -math.inf, ""

        def show(part: str, done: int, at_most: int, rmse_rad_s: float) -> None:
            nonlocal shown_s, shown_part
            now_s = time.monotonic()
            if part != shown_part or now_s - shown_s >= LINE_PERIOD_S:
                shown_s, shown_part = now_s, part
                count = f" {done}/{at_most}" if at_most else ""
                typer.echo(f"{prefix}{part}{count}{error(rmse_rad_s)}, {now_s - started_s:.0f} s", err=True)

        return show

    if not console.is_terminal:
        yield start_lines
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("{task.fields[count]}"))
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as bars:

        def start_bar(name: str) -> ProgressCallback:
            prefix = f"{name}: " if name else ""
            shown_part = ""

            def show(part: str, done: int, at_most: int, rmse_rad_s: float) -> None:
                nonlocal shown_part
                count = f"{done}/{at_most}" if at_most else ""
                description = f"{prefix}{part}{error(rmse_rad_s)}"
                if part != shown_part:  # each has a bar of its own
                    shown_part = part
                    for task in bars.task_ids:
                        bars.remove_task(task)
                    bars.add_task(description, total=at_most or None, count=count)
                bars.update(bars.task_ids[0], completed=done, description=description, count=count)

            return show

        yield start_bar
