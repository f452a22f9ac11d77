"""Progress of commands: one display for all long work, a bar on a terminal and lines elsewhere."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.util import find_spec
from typing import TYPE_CHECKING, Self

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

if TYPE_CHECKING:
    from fantwin.pipeline.learning.training_data import TrainingData
    from fantwin.twin.progress import Progress as ProgressCallback

LINE_PERIOD_S, LONGEST_LINE_PERIOD_S = 5.0, 60.0
"""between lines of the same work: it doubles up to the second"""
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


class Reporter:
    """Shows on standard error what is being done: a bar on a terminal or in a notebook, which disappears at the end.

    Elsewhere a line comes when something else is done than before, and then ever more rarely. A context manager.
    """

    def __init__(self, quietly: str = "", *, only_bar: bool = False) -> None:
        """quietly: what begins without a line. only_bar: nothing elsewhere, as a program wants it."""
        self.console = console = Console(stderr=True, highlight=False)
        """what is printed with it stands above the bar"""
        has_bar = console.is_terminal or (console.is_jupyter and find_spec("ipywidgets") is not None)
        self._has_lines = not has_bar and not only_bar
        work = (TextColumn("{task.description}", markup=False), BarColumn(20), TextColumn("{task.fields[count]}"))
        times = (TimeElapsedColumn(), TextColumn("so far, up to"), TimeRemainingColumn(), TextColumn("left"))
        columns = (*work, TaskProgressColumn(), *times)
        self._bars = Progress(*columns, console=console, transient=True, disable=not has_bar)
        self._bar: TaskID | None = None
        self._doing = quietly
        self.restart()

    def restart(self) -> None:
        """Count the time from now on."""
        self._started_s = self._shown_s = self._part_s = time.monotonic()
        self._period_s, self._part_done = LINE_PERIOD_S, 0

    def show(self, doing: str, done: int = 0, at_most: int = 0, note: str = "") -> None:
        """Say what is being done, how much of it is done, and more about it."""
        count = f"{done}/{at_most}" if at_most else ""
        is_new, now_s = doing != self._doing, time.monotonic()
        self._doing = doing
        if is_new:
            self._part_s, self._part_done, self._period_s = now_s, done, LINE_PERIOD_S
        if self._has_lines and (is_new or now_s - self._shown_s >= self._period_s):
            self._period_s = self._period_s if is_new else min(2.0 * self._period_s, LONGEST_LINE_PERIOD_S)
            self._shown_s, took_s = now_s, now_s - self._started_s
            took = f", {took_s:.0f} s so far" if at_most or took_s >= 1.0 else ""
            if done > self._part_done and (left := (at_most - done) / (done - self._part_done)) > 0.0:
                took += f", up to {left * (now_s - self._part_s):.0f} s left"
            typer.echo(f"{doing}{f' {count}' if count else ''}{f', {note}' if note else ''}{took}", err=True)
        text = ", ".join(filter(None, (doing, note)))
        if is_new and self._bar is not None:  # each has a bar of its own
            self._bars.remove_task(self._bar)
            self._bar = None
        if self._bar is None:
            self._bar = self._bars.add_task(text, total=at_most or None, count=count)
        self._bars.update(self._bar, completed=done, description=text, count=count)

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._bars.stop()


@contextmanager
def working(title: str) -> Iterator[Callable[[str], None]]:
    """Around work of unknown length; yields a function that shows which part is being done."""
    with Reporter() as reporter:
        reporter.show(title)
        yield reporter.show


@contextmanager
def recordings_progress(doing: str, count: int) -> Iterator[Callable[[], None]]:
    """Around work on so many recordings. Yields a function that says that one more is done.

    Inside, `show_part` shows what is being done.
    """
    done = 0

    def show(part: str = "") -> None:
        reporter.show(doing, done, count, part)

    def advance() -> None:
        nonlocal done
        done += 1
        show()

    with Reporter(quietly=doing) as reporter:
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
def training_progress(
    training_data: TrainingData, *, only_bar: bool = False
) -> Iterator[Callable[[str], ProgressCallback]]:
    """Around identification and training; yields a function that starts the display of one by its name and returns its
    progress callback. only_bar: as of `Reporter`."""
    with Reporter(only_bar=only_bar) as reporter:

        def start(name: str) -> ProgressCallback:
            reporter.restart()
            prefix = f"{name}: " if name else ""

            def show(part: str, done: int, at_most: int, rmse_rad_s: float) -> None:
                in_unit = rmse_rad_s / training_data.rad_s_per_unit
                error = "" if math.isnan(in_unit) else f"free-run rmse {in_unit:.4g} {training_data.speed_unit}"
                reporter.show(f"{prefix}{part}", done, at_most, error)

            return show

        yield start
