"""Real measured tables: imported with the counts they have, and a twin of one part predicts the rest.

The same commands stand in docs/how-to/datasets.md.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.training_runs import read_runs
from fantwin.schemas.enums import InvalidReason
from tests.support.fantwin_command import fantwin

pytestmark = pytest.mark.data

RPM = 60 / (2 * np.pi)
ESC_TEST = ("--time", "Timestamp", "--command", "Duty", "--speed", "RPM:rpm")
ROSA = ("--time", "Time:ms", "--command", "Shaft Control Effort", "--speed", "Actual Speed:rpm")


def imported(table: Path, recording: Path, *columns: str) -> dict:
    return json.loads(fantwin("import", table, *columns, "-o", recording, "--json").stdout)


def test_esc_test_is_imported_with_its_dates_and_repeated_times(measured_data, tmp_path):
    table, recording = measured_data / "esc_test" / "f40_steps_5-2.csv", tmp_path / "esc.mcap"
    result = imported(table, recording, *ESC_TEST)
    ours = pd.read_csv(table)
    time = pd.to_datetime(ours["Timestamp"], format="%Y-%m-%d %H:%M:%S:%f")
    merged = ours.groupby(time).agg({"RPM": "mean", "Duty": "last"})
    assert (result["rows"], result["samples"]) == (len(ours), len(merged))
    assert result["repeated"] == int(time.duplicated().sum()) > 0.06 * len(ours)
    assert result["out_of_order"] == result["without_time"] == result["speeds_missing"] == 0
    assert result["duration_s"] == (time.iloc[-1] - time.iloc[0]).total_seconds()
    (run,) = read_runs(recording).runs
    np.testing.assert_allclose(run.speed_rad_s[:, 0] * RPM, merged["RPM"], rtol=1e-12)
    np.testing.assert_array_equal(run.command[:, 0], merged["Duty"])
    np.testing.assert_allclose(run.t_s, (merged.index - merged.index[0]).total_seconds(), rtol=0, atol=1e-9)


def test_rosa_is_imported_in_spite_of_its_blanks_and_byte_order_mark(measured_data, tmp_path):
    table, recording = measured_data / "rosa" / "healthy_103.csv", tmp_path / "rosa.mcap"
    result = imported(table, recording, *ROSA)
    ours = pd.read_csv(table, encoding="utf-8-sig")
    ours.columns = ours.columns.str.strip()
    assert (result["samples"], result["repeated"]) == (len(ours), int(ours["Time"].duplicated().sum()))
    assert result["duration_s"] == pytest.approx((ours["Time"].iloc[-1] - ours["Time"].iloc[0]) / 1000)
    (run,) = read_runs(recording).runs
    np.testing.assert_allclose(run.speed_rad_s[:, 0] * RPM, ours["Actual Speed"], rtol=1e-12)
    np.testing.assert_array_equal(run.command[:, 0], ours["Shaft Control Effort"])


def test_imrclab_is_imported_as_four_fans_of_one_command_without_times(measured_data, tmp_path):
    table = measured_data / "imrclab" / "cf21_stock2.csv"
    speeds = [option for k in (1, 2, 3, 4) for option in ("--speed", f"rpm{k}:rpm")]
    result = imported(table, tmp_path / "imrc.mcap", "--period", "10ms", "--command", "pwm", *speeds)
    ours = pd.read_csv(table)
    assert (result["samples"], result["fans"]) == (len(ours), 4)
    assert result["duration_s"] == pytest.approx((len(ours) - 1) * 0.01)


IMRCLAB = ("--period", "10ms", "--command", "pwm", *(f"--speed=rpm{k}:rpm" for k in (1, 2, 3, 4)))


@pytest.mark.parametrize(
    ("file", "columns", "trained_on", "held_out"),
    [
        ("esc_test/f40_steps_5-2.csv", ESC_TEST, ("--from", 20), ("--to", 20)),
        ("imrclab/cf21_stock2.csv", IMRCLAB, ("--to", 9), ("--from", 9, "--to", 14)),
    ],
)
def test_a_recipe_for_public_data_ends_in_a_twin_that_follows(
    file, columns, trained_on, held_out, measured_data, tmp_path
):
    recording, twin = tmp_path / "all.mcap", tmp_path / "twin.onnx"
    imported(measured_data / file, recording, *columns)
    assert fantwin("train", recording, *trained_on, "--model", "physical", "-o", twin).exit_code == 0
    found = json.loads(fantwin("evaluate", twin, recording, *held_out, "--json").stdout)
    assert found["assessment"] == "as declared", found["headline"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "columns", "first_part_s", "end_s"),
    [("esc_test/f40_steps_5-2.csv", ESC_TEST, 80, 115), ("rosa/healthy_103.csv", ROSA, 30, 48)],
)
def test_a_twin_of_the_first_part_predicts_the_rest_and_is_believed_only_where_it_was_trained(
    file, columns, first_part_s, end_s, measured_data, tmp_path
):
    recording, twin, judged = (tmp_path / name for name in ("all.mcap", "twin.onnx", "judged.mcap"))
    imported(measured_data / file, recording, *columns)
    part = ("--from", first_part_s, "--to", end_s)
    for words in (
        ("train", recording, "--model", "physical", "--to", first_part_s, "-o", twin),
        ("replay", recording, "--offline", "--twin", twin, *part, "-o", judged),
    ):
        done = fantwin(*words)
        assert done.exit_code == 0, done.exception
        has_loop = "closed loop" in done.output
        assert has_loop == (words[0] == "train" and file.startswith("rosa")), "a motor in open loop has none"
    found: dict[str, list[Any]] = {}
    for entry in read_recording(judged):
        found.setdefault(entry.topic, []).append(entry.message)
    valid, reason, command, measured, predicted = (
        np.concatenate([getattr(message, column) for message in found["prediction"]])
        for column in ("valid", "invalid_reason", "command", "measured_speed_rad_s", "predicted_speed_rad_s")
    )
    scored = np.concatenate([message.valid for message in found["score"]])
    (card,) = found["twin"]
    low, high = json.loads(card.card_json)["command_range"]
    beyond = (command < low - 0.05 * (high - low)) | (command > high + 0.05 * (high - low))
    assert not valid[beyond].any(), "a twin is not valid beyond its training commands"
    stands = reason == InvalidReason.STOPPED
    assert (valid | stands).mean() > 0.25
    assert scored[valid].all() and not scored[stands].any()
    assert np.sqrt(np.mean((measured - predicted)[valid] ** 2)) < 0.1 * np.nanmax(measured)
