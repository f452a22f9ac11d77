"""Progress on stderr while a command works without a terminal."""

from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import pytest

from pipeline.cli import progress

if TYPE_CHECKING:
    from pipeline.cli.twins.training_data import TrainingData

TRAINING_DATA = cast("TrainingData", SimpleNamespace(rad_s_per_unit=0.1, speed_unit="rpm"))


def test_without_a_terminal_a_line_reports_training_progress_every_few_seconds(monkeypatch, capsys) -> None:
    now_s = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now_s[0])
    with progress.training_progress(TRAINING_DATA) as start:
        report = start("hybrid")
        for iteration in range(1, 14):
            now_s[0] += 1.0
            report(iteration, 60, 0.5)
        start("NARX")
    output = capsys.readouterr()
    assert output.err.splitlines() == [
        "hybrid: identifying",
        "hybrid: 5/60, free-run rmse 5 rpm, 5 s",
        "hybrid: 10/60, free-run rmse 5 rpm, 10 s",
        "NARX: identifying",
    ]
    assert output.out == ""


def test_without_a_terminal_work_is_reported_once(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.working("drawing page.html"):
        pass
    assert capsys.readouterr().err == "drawing page.html\n"
