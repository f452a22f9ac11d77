"""`fantwin train` and `fantwin calibrate` on recordings of two trays: `--tray` uses the samples of one only."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.recordings.reading import read_recording
from pipeline.recordings.writing import RecordingWriter
from schemas.header import Header
from schemas.messages import Raw
from schemas.topics import tray_key
from tests.support.fantwin_command import error_of, fantwin

RATE = ("--false-alarms-per-day", 3000)


def simulated(path: Path, seed: int, seconds: float, fans: int = 1) -> Path:
    """Of fans that differ from those of other seeds."""
    words = ("--fans", fans, "--profile", "multisine", "--seed", seed, "--fans-seed", seed, "--fan-variation", 0.2)
    result = fantwin("simulate", *words, "--duration", seconds, "--epoch-ns", 0, "--recording", path)
    assert result.exit_code == 0, result.output
    return path


def together(path: Path, **recordings: Path) -> Path:
    """One recording of several trays, by name."""
    with RecordingWriter(path, {"trays": ",".join(recordings), "speed_unit": "rad/s"}) as writer:
        for tray, recording in recordings.items():
            for sequence, envelope in enumerate(read_recording(recording, ("raw",))):
                raw = envelope.message
                assert isinstance(raw, Raw)
                raw = replace(raw, header=Header("simulate", sequence, tray))
                writer.add_message(tray_key("simulated", tray, "raw"), raw, int(raw.host_receive_t_ns[-1]))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of tray a alone, and of a and b together, and a twin of a."""
    path = tmp_path_factory.mktemp("trays")
    for name, seed, seconds in (("training", 1, 60), ("healthy", 2, 120), ("other", 3, 60)):
        one = together(path / f"{name}-a.mcap", a=simulated(path / "a.mcap", seed, seconds))
        together(path / f"{name}.mcap", a=one, b=simulated(path / "b.mcap", seed + 10, seconds))
        (path / "a.mcap").unlink()
        (path / "b.mcap").unlink()
    made = fantwin("train", path / "training.mcap", "--tray", "a", "--model", "physical", "-o", path / "twin.onnx")
    assert made.exit_code == 0, made.output
    return path


def calibrated(folder: Path, recording: str, *words: object) -> dict[str, Any]:
    output = folder / "calibrated.onnx"
    result = fantwin("calibrate", folder / "twin.onnx", folder / recording, *RATE, "-o", output, "--json", *words)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)["calibration"]


def test_the_twin_of_a_tray_is_trained_on_its_samples_only(folder: Path) -> None:
    words = ("train", folder / "training-a.mcap", "--model", "physical", "-o", folder / "alone.onnx", "--json")
    alone = json.loads(fantwin(*words).stdout)
    words = ("train", folder / "training.mcap", *words[2:], "--tray", "a")
    assert json.loads(fantwin(*words).stdout)["sigma"] == alone["sigma"]
    other = json.loads(fantwin(*words[:-1], "b").stdout)
    assert other["sigma"] != alone["sigma"]


def test_the_limits_of_a_tray_are_those_of_its_samples_only(folder: Path) -> None:
    alone, chosen = calibrated(folder, "healthy-a.mcap"), calibrated(folder, "healthy.mcap", "--tray", "a")
    rates = [found.pop("declared_rate") for found in (alone, chosen)]
    assert chosen == alone
    assert rates[0]["fan_hours"] == rates[1]["fan_hours"]
    assert [entry.get("tray") for rate in rates for entry in rate["data"]] == [None, "a"]


def test_without_a_tray_all_are_used(folder: Path) -> None:
    chosen, both = (calibrated(folder, "healthy.mcap", *words) for words in (("--tray", "a"), ()))
    assert both["declared_rate"]["fan_hours"] == pytest.approx(2 * chosen["declared_rate"]["fan_hours"], rel=0.05)
    assert both["declared_rate"]["runs"] == 2


def test_the_declared_rate_is_tested_on_the_chosen_tray_only(folder: Path) -> None:
    words = ("calibrate", folder / "twin.onnx", folder / "healthy.mcap", *RATE, "-o", folder / "verified.onnx")
    found = fantwin(*words, "--tray", "a", "--verify", folder / "other.mcap", "--json")
    assert json.loads(found.stdout)["verify"]["fan_hours"] == pytest.approx(60 / 3600, rel=0.1)


def test_where_the_twin_fits_only_some_of_the_trays_one_must_be_chosen(folder: Path) -> None:
    two, one = simulated(folder / "two.mcap", 7, 60, fans=2), simulated(folder / "one.mcap", 8, 60)
    both, twin = together(folder / "both.mcap", a=two, b=one), folder / "of-two.onnx"
    training = simulated(folder / "training-two.mcap", 9, 60, fans=2)
    made = fantwin("train", training, "--model", "physical", "-o", twin)
    assert made.exit_code == 0, made.output
    expected = f"{both}: several trays, a of 2 fans, b of 1 fan, and a twin of 2 fans: choose one with --tray"
    assert error_of("calibrate", twin, both, *RATE) == expected
    words = ("calibrate", twin, two, *RATE, "--extrapolate")
    assert error_of(*words, "--verify", both) == expected
    words = ("calibrate", twin, both, *RATE, "--extrapolate", "--tray", "a", "-o", folder / "chosen.onnx")
    assert fantwin(*words).exit_code == 0
