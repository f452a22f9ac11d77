"""Recordings and twins that tests of several commands share, made once a session."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from fantwin.pipeline.learning import drops_found
from tests.support.fantwin_command import fantwin
from tests.support.healthy_site import EPOCH_NS, HEALTHY_S, OTHER_S, PER_DAY, recorded
from tests.support.made_once import MadeOnce


@pytest.fixture(scope="module", autouse=True)
def _drops_of_seconds() -> Iterator[None]:
    """The drops that a twin finds are asked of fans that run for seconds before and after them, not for minutes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drops_found, "STEADY_S", 5.0)
        patch.setattr(drops_found, "WITHIN_S", (1.0, 2.0, 4.0))
        yield


@pytest.fixture(autouse=True)
def _restored_signals() -> Iterator[None]:
    """Commands run in the process of their tests: puts back its signal handlers."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages of reports have no figures, which take a second a fan: the test is about their words and numbers."""
    monkeypatch.setattr("fantwin.twin.report.page.fan_figures", lambda *_: [])


@pytest.fixture(scope="module")
def healthy(made_once: MadeOnce) -> Path:
    """Four recordings of two simulated fans, one of them with a fault of fan 1; their twin; the twin with limits, and
    the JSON of its calibration."""

    def make(folder: Path) -> None:
        for seed, name, seconds in ((1, "training", 40), (2, "healthy", HEALTHY_S), (3, "other", OTHER_S)):
            recorded(folder / f"{name}.mcap", seed, seconds)
        recorded(folder / "faulty.mcap", 5, OTHER_S, has_fault=True)
        twin, calibrated = folder / "twin.onnx", folder / "calibrated.onnx"
        for words in (
            ("train", folder / "training.mcap", "--model", "physical", "-o", twin),
            ("calibrate", twin, folder / "healthy.mcap", "--false-alarms-per-day", PER_DAY, "-o", calibrated,
             "--verify", folder / "other.mcap", "--json"),
        ):  # fmt: skip
            result = fantwin(*map(str, words))
            assert result.exit_code == 0, result.output
        (folder / "calibrated.json").write_text(result.stdout)

    return made_once(f"healthy-{EPOCH_NS}", make)
