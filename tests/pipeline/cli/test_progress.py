"""Progress on stderr while a command works without a terminal."""

import math
import re
import signal
from collections.abc import Iterator
from functools import partial
from io import StringIO
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import pytest
import typer
from rich.console import Console

from fantwin.pipeline.cli import progress

if TYPE_CHECKING:
    from fantwin.pipeline.learning.training_data import TrainingData

TRAINING_DATA = cast("TrainingData", SimpleNamespace(rad_s_per_unit=0.1, speed_unit="rpm"))


def test_without_a_terminal_a_line_reports_each_part_and_then_its_progress_ever_more_rarely(
    monkeypatch, capsys
) -> None:
    now_s = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now_s[0])
    with progress.training_progress(TRAINING_DATA) as start:
        report = start("hybrid")
        for iteration in range(1, 50):
            now_s[0] += 1.0
            report("training", iteration, 60, 0.5)
        report("evaluation", 0, 0, math.nan)
        start("NARX")("identification", 1, 9, math.nan)
    output = capsys.readouterr()
    assert output.err.splitlines() == [
        "hybrid: training 1/60, free-run rmse 5 rpm, 1 s so far",
        "hybrid: training 6/60, free-run rmse 5 rpm, 6 s so far, up to 54 s left",
        "hybrid: training 16/60, free-run rmse 5 rpm, 16 s so far, up to 44 s left",
        "hybrid: training 36/60, free-run rmse 5 rpm, 36 s so far, up to 24 s left",
        "hybrid: evaluation, 49 s so far",
        "NARX: identification 1/9, 0 s so far",
    ]
    assert output.out == ""


def test_on_a_terminal_the_bar_has_the_share_and_the_time_left(monkeypatch) -> None:
    screen = StringIO()
    monkeypatch.setattr(progress, "Console", partial(Console, file=screen, force_terminal=True, width=120))
    with progress.training_progress(TRAINING_DATA) as start:
        report = start("hybrid")
        for iteration in (0, 15, 30):
            report("training", iteration, 60, 0.5)
    assert "30/60" in screen.getvalue() and "50%" in screen.getvalue()
    assert re.search(r"so far, up to.*\d:\d\d:\d\d.*left", screen.getvalue())


def test_without_a_terminal_work_is_reported_once(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.working("drawing page.html"):
        pass
    assert capsys.readouterr().err == "drawing page.html\n"


@pytest.fixture
def _signals_of_a_new_process() -> Iterator[None]:
    """Commands that tests have run in this process may have left handlers behind."""
    wakeup, before = signal.set_wakeup_fd(-1), signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
    signal.set_wakeup_fd(wakeup, warn_on_full_buffer=False)


@pytest.mark.usefixtures("_signals_of_a_new_process")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_end_with_one_line_and_their_own_exit_code(
    capsys: pytest.CaptureFixture[str], number: signal.Signals
) -> None:
    with pytest.raises(typer.Exit) as ended, progress.interruptible("no twin was written"):
        signal.raise_signal(number)
    assert ended.value.exit_code == 130
    assert capsys.readouterr().err == "interrupted: no twin was written\n"
