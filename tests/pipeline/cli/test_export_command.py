"""`fantwin export`: tables in which pandas finds every sample of every fan, and nothing that was not recorded."""

import json
import re
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from fantwin.pipeline.recordings import read_arrays
from fantwin.pipeline.recordings.export_tables import table_columns
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.codec import proto_type
from fantwin.schemas.enums import FanState
from fantwin.schemas.messages import ModelCard, Raw
from tests.support.failing_writers import disk_of
from tests.support.fantwin_command import error_of, fantwin
from tests.support.made_messages import MESSAGE_TYPES
from tests.support.score_data import START_NS, made_up_tray
from tests.support.small_recordings import alarm, raw, write

READING = Path(__file__).parents[3] / "docs" / "how-to" / "read-recordings.md"
FORMS = ("csv", "parquet")


def recording(folder: Path, *, trays: tuple[str, ...] = ("tray1",), alarms: bool = True) -> Path:
    """Raw samples, scores and alarms of some trays."""
    messages = [raw(n, tray=tray) for n in range(3) for tray in trays]
    for tray in trays:
        messages += made_up_tray(tray=tray, seconds=2, gap_s=(1.0, 1.5), fault_s=(0.5, 1.2))[0]
    return write(
        folder / "r.mcap", [*messages, *([alarm(0)] if alarms else [])], {"site": "plant", "speed_unit": "rpm"}
    )


def table(path: Path) -> pd.DataFrame:
    return pd.read_csv(path) if path.suffix == ".csv" else pd.read_parquet(path)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("form", FORMS)
def test_pandas_finds_every_sample_of_every_fan_with_its_exact_numbers(tmp_path, form):
    path = recording(tmp_path)
    result = fantwin("export", path, "--to", form, "-o", tmp_path / "out")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == f"{tmp_path}/out/r.tray1.score.{form}: 600 rows\n"
    frame = table(tmp_path / "out" / f"r.tray1.score.{form}")
    (block,) = read_arrays(path, "score")
    assert len(frame) == 200 * 3
    assert frame["fan"].tolist() == [0, 1, 2] * 200
    assert frame["t_ns"].dtype == np.int64
    np.testing.assert_array_equal(frame["t_ns"], np.repeat(block.t_ns, 3))
    for name in ("command", "measured_speed_rad_s", "predicted_speed_rad_s", "residual_rad_s", "outside", "valid"):
        is_text = form == "csv" and block[name].dtype == np.float32  # pandas reads numbers in text with 64 bits
        found = frame[name].astype(np.float32) if is_text else frame[name]
        np.testing.assert_array_equal(found, block[name].ravel(), name)
        assert found.dtype == block[name].dtype
    wide = frame.pivot(index="t_ns", columns="fan", values="measured_speed_rad_s")
    np.testing.assert_array_equal(wide.to_numpy().astype(np.float32), block["measured_speed_rad_s"])


@pytest.mark.parametrize("form", FORMS)
def test_enums_are_names_and_missing_values_are_empty(tmp_path, form):
    fantwin("export", recording(tmp_path), "--to", form, "-o", tmp_path / f"scores.{form}")
    frame = table(tmp_path / f"scores.{form}")
    if form == "csv":
        assert "nan" not in (tmp_path / "scores.csv").read_text()
    else:
        assert pq.read_table(tmp_path / "scores.parquet")["measured_speed_rad_s"].null_count == 50
    (gap,) = frame.query(f"fan == 1 and t_ns == {START_NS + 1_200_000_000}").to_dict("records")
    assert (gap["state"], gap["invalid_reason"], gap["valid"]) == ("UNKNOWN", "GAP", False)
    assert np.isnan(gap["measured_speed_rad_s"])
    assert set(frame["state"]) == {"NORMAL", "SUSPECT", "ALARM", "RETURNING", "UNKNOWN"}
    assert set(frame["invalid_reason"]) == {"NONE", "GAP"}


def test_parquet_has_timestamps_and_describes_its_source(tmp_path):
    fantwin("export", recording(tmp_path), "--to", "parquet", "-o", tmp_path)
    path = tmp_path / "r.tray1.score.parquet"
    frame = table(path)
    assert str(frame["time"].dtype) == "datetime64[ns, UTC]"
    assert frame["time"].astype("int64").tolist() == frame["t_ns"].tolist()
    assert str(frame["state"].dtype) == "category"
    metadata = {name.decode(): value.decode() for name, value in pq.read_schema(path).metadata.items()}
    assert metadata["fantwin.site"] == "plant"
    assert metadata["fantwin.tray"] == "tray1"
    assert metadata["fantwin.topic"] == "score"
    assert metadata["fantwin.speed_unit"] == "rpm"
    assert metadata["fantwin.exported_by"] == f"fantwin {version('fantwin')}"
    assert "fantwin.damage" not in metadata


@pytest.mark.parametrize("form", FORMS)
def test_columns_that_the_messages_lack_are_empty_and_alarms_are_a_separate_table(tmp_path, form):
    card = ModelCard(t_ns=6, twin="t", kind="hybrid", sha256="00")
    path = write(tmp_path / "r.mcap", [raw(0), raw(1, clock=False), card, alarm(0)])
    topics = (word for topic in ("raw", "twin", "alarm") for word in ("--topic", topic))
    assert fantwin("export", path, "--to", form, *topics, "-o", tmp_path).exit_code == 0
    frame = table(tmp_path / f"r.tray1.raw.{form}")
    assert frame["device_clock_us"].isna().tolist() == [False] * 20 + [True] * 20
    (twin,) = (table(p).to_dict("records") for p in tmp_path.glob(f"*.twin.{form}"))
    assert (len(twin), twin[0]["kind"], pd.isna(twin[0]["sigma_rad_s"])) == (1, "hybrid", True)
    (row,) = table(tmp_path / f"r.tray1.alarm.{form}").to_dict("records")
    assert (row["t_ns"], row["onset_t_ns"], row["fan"], row["active"]) == (70, 50, 0, True)
    assert (row["severity"], row["message"], row["producer"]) == ("ALARM", "alarm 0", "scorer-1")
    assert (row["transition"], row["statistic"]) == ("RAISED", "DEVIATION")


@pytest.mark.parametrize("form", FORMS)
def test_an_unknown_value_of_a_newer_producer_is_its_number(tmp_path, form):
    (score, *_), _ = made_up_tray(seconds=1)
    state = score.state.copy()
    state[1, 2] = 99
    path = write(tmp_path / "r.mcap", [replace(score, state=state)])
    fantwin("export", path, "--to", form, "-o", tmp_path / f"scores.{form}")
    frame = table(tmp_path / f"scores.{form}")
    assert frame["state"].tolist()[5] == "99"
    assert set(frame["state"]) - {"99"} <= {known.name for known in FanState}


def test_there_is_a_table_for_each_topic_and_tray_of_scores_or_else_raw_samples_if_none_is_named(tmp_path):
    path = recording(tmp_path, trays=("left", "right"))
    out = tmp_path / "out"
    assert fantwin("export", path, "--to", "csv", "--topic", "score", "--topic", "raw", "-o", out).exit_code == 0
    assert names(out) == ["r.left.raw.csv", "r.left.score.csv", "r.right.raw.csv", "r.right.score.csv"]
    assert fantwin("export", path, "--to", "csv", "--tray", "left", "-o", tmp_path / "left").exit_code == 0
    assert names(tmp_path / "left") == ["r.left.score.csv"]
    path = write(tmp_path / "raw.mcap", [raw(0), raw(1)])
    assert fantwin("export", path, "--to", "csv", "-o", out).stdout == f"{out}/raw.tray1.raw.csv: 40 rows\n"


def test_parts_become_one_table_under_the_name_of_the_first(tmp_path):
    late = write(tmp_path / "a.mcap", (raw(n) for n in range(2, 6)), start=100)
    early = write(tmp_path / "b.mcap", (raw(n) for n in range(4)))
    result = fantwin("export", late, early, "--to", "csv", "-o", tmp_path, "--json")
    report = json.loads(result.stdout)
    assert report["tables"] == [{"file": f"{tmp_path}/b.tray1.raw.csv", "topic": "raw", "tray": "tray1", "rows": 120}]
    assert report["duplicated"] == 2
    assert table(tmp_path / "b.tray1.raw.csv")["host_receive_t_ns"].is_monotonic_increasing


def test_the_readable_part_of_a_truncated_recording_is_exported_with_exit_code_3(tmp_path):
    whole = write(tmp_path / "whole.mcap", (raw(n) for n in range(3000)))
    path = tmp_path / "truncated.mcap.active"
    path.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    result = fantwin("export", path, "--to", "parquet", "-o", tmp_path, "--json")
    assert result.exit_code == 3
    assert result.stderr == f"{path}: it is truncated, as after a crash; read up to that point\n"
    report = json.loads(result.stdout)
    assert report["damage"] == [result.stderr.strip()]
    table_file = tmp_path / "truncated.tray1.raw.parquet"
    assert 0 < len(table(table_file)) == report["tables"][0]["rows"] < 3000 * 20
    assert pq.read_metadata(table_file).metadata[b"fantwin.damage"].decode() == report["damage"][0]


def test_an_existing_table_is_replaced_only_with_force_and_only_by_a_complete_one(tmp_path):
    path = recording(tmp_path)
    out = tmp_path / "out"
    out.mkdir()
    (out / "r.tray1.score.csv").write_text("mine")
    with disk_of(20_000):
        error = error_of("export", path, "--to", "csv", "-o", out, "--force")
    assert "r.tray1.score.csv: cannot be written: File too large" in error
    assert (out / "r.tray1.score.csv").read_text() == "mine"
    assert fantwin("export", path, "--to", "csv", "-o", out, "--force").exit_code == 0
    assert len(table(out / "r.tray1.score.csv")) == 600
    assert names(out) == ["r.tray1.score.csv"]


def test_one_file_holds_one_table_of_one_site(tmp_path):
    with RecordingWriter(tmp_path / "sites.mcap", {}) as writer:
        for site in ("here", "there"):
            writer.add_message(f"fantwin/{site}/tray1/raw", raw(0), 1)
    assert "would hold both" in error_of("export", tmp_path / "sites.mcap", "--to", "csv", "-o", tmp_path / "out")


def test_a_tray_of_any_name_has_a_file_of_a_plain_name(tmp_path):
    with RecordingWriter(tmp_path / "r.mcap", {}) as writer:
        writer.add_message("fantwin/here/a\0b\n\x1b[31m/raw", raw(0), 1)
    result = fantwin("export", tmp_path / "r.mcap", "--to", "csv", "-o", tmp_path / "out")
    assert (result.exit_code, names(tmp_path / "out")) == (0, ["r.a_b__[31m.raw.csv"])
    assert result.stdout == f"{tmp_path}/out/r.a_b__[31m.raw.csv: 20 rows\n"


def test_the_examples_of_the_documentation_run(tmp_path, monkeypatch, capsys):
    recording(tmp_path).rename(tmp_path / "recording.mcap")
    monkeypatch.chdir(tmp_path)
    assert fantwin("export", "recording.mcap", "--to", "parquet", "-o", "tables").exit_code == 0
    examples = re.findall(r"```python\n(.*?)```", READING.read_text(encoding="utf-8"), re.DOTALL)
    assert len(examples) == 4
    for example in examples:
        exec(example, {})
    assert "(200,) (200, 3)" in capsys.readouterr().out


def test_every_topic_has_a_table_of_plain_columns_and_enums_are_names():
    for kind in MESSAGE_TYPES:
        found = table_columns(kind)
        assert next(iter(found)) == ("host_receive_t_ns" if kind is Raw else "t_ns")
        assert ("fan" in found) == (kind.__name__ not in ("Health", "Clock", "Consumed", "NewTwin", "ScorerSnapshot"))
        assert all(column.dtype.kind in "iufbO" for column in found.values())
        enums = {f.name for f in proto_type(kind).DESCRIPTOR.fields if f.enum_type}
        assert {name for name, column in found.items() if column.enum} == enums
