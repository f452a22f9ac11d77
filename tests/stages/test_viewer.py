from __future__ import annotations

import shutil
import socket
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.rerun.viewer_core import FLUSH_PERIOD_NS, REPEAT_STATES_NS, SAMPLES_HELD, ViewerCore
from fantwin.pipeline.runtime.stage import StageError
from fantwin.schemas.units import RAD_S_PER_UNIT
from fantwin.stages.viewer import build, check
from tests.support.drawn_views import LATER_NS, FakeSink, context, play, rows_of, sent, styles_of
from tests.support.ports import free_port
from tests.support.score_data import SIGMA, made_up_tray


def core_of(sink: FakeSink, fans: int = 3, **tray: Any) -> ViewerCore:
    return ViewerCore("site", [TrayConfig(name="tray1", fans=fans, **tray)], sink)


def test_samples_are_drawn_twice_a_second_each_exactly_once_and_without_ticks_a_bounded_number_is_held() -> None:
    sink = FakeSink()
    scores, _ = made_up_tray(seconds=10, block=5)
    core = core_of(sink)
    play(core, scores)
    assert len(sink.traces) in (20, 21)
    core.close()
    assert sink.closed and sink.flushed == len(sink.traces)
    times = np.concatenate([trace.t_ns for trace in sink.traces])
    assert times.tolist() == np.concatenate([score.t_ns for score in scores]).tolist()
    assert core.counters()["samples_drawn"] == 1000
    sink = FakeSink()
    core = core_of(sink, fans=1)
    for score in made_up_tray(seconds=50, fans=1, block=64, gap_fan=None, faulty_fan=None)[0]:
        core.step(sent(score))
    assert [len(trace.t_ns) for trace in sink.traces] == [SAMPLES_HELD]


def test_a_lane_follows_the_states_to_the_sample_and_repeats_a_steady_one_for_viewers_that_join_late() -> None:
    sink = FakeSink()
    scores, _ = made_up_tray(seconds=4, fans=2, faulty_fan=0, fault_s=(1.0, 2.0), gap_fan=1, gap_s=(2.5, 3.0))
    play(core_of(sink, fans=2), scores)
    assert sink.lane(0) == [(0, "normal"), (1, "suspect"), (1.5, "alarm"), (2, "returning"), (2.5, "normal")]
    assert sink.lane(1) == [(0, "normal"), (2.5, "unknown: gap"), (3, "normal")]
    sink = FakeSink()
    play(core_of(sink, fans=1), made_up_tray(seconds=16, fans=1, faulty_fan=None, gap_fan=None)[0])
    times = [t for t, _ in sink.lane(0)]
    assert len(times) == 4
    assert (np.diff(times)[1:] * 1e9 >= REPEAT_STATES_NS).all()


def test_the_file_of_a_replay_holds_every_sample_with_its_unit_its_states_and_its_alarms_also_after_a_kill(
    tmp_path: Path,
) -> None:
    scores, alarms = made_up_tray(seconds=20)
    half = len(scores) // 2
    volts = [np.full(score.score.shape, 12.0 + number, np.float32) for number, score in enumerate(scores)]
    measured_beside = [replace(score, supply_voltage_v=of) for score, of in zip(scores, volts, strict=True)]
    core = build(context(tmp_path, speed_unit="rpm")).core
    for number, item in enumerate((*scores[:half], *measured_beside[half:], *alarms)):
        core.step(sent(item))
        core.tick(LATER_NS + number * FLUSH_PERIOD_NS)
    left = Path(shutil.copy(tmp_path / "view.rrd", tmp_path / "left.rrd"))  # what a process that is killed now leaves
    core.close()
    assert len(rows_of(left)["/tray1/fan_0/speed"]) >= 1900
    assert styles_of(left, "/tray1/fan_0/speed", "Measurements:names")[0] == "measured (rpm)"
    rows = rows_of(tmp_path / "view.rrd")
    times = [t_ns for entity in rows.values() for t_ns, _ in entity]
    assert (min(times), max(times)) == (int(scores[0].t_ns[0]), int(scores[-1].t_ns[-1])), "none is the host's"
    speed = rows["/tray1/fan_2/speed"]
    assert [t for t, _ in speed] == np.concatenate([score.t_ns for score in scores]).tolist()
    measured, predicted, lowest, highest = np.array([row["Measurements:values"] for _, row in speed]).T
    rpm = 1 / RAD_S_PER_UNIT["rpm"]
    np.testing.assert_allclose(measured, np.concatenate([s.measured_speed_rad_s[:, 2] for s in scores]) * rpm)
    np.testing.assert_allclose(predicted, np.concatenate([s.predicted_speed_rad_s[:, 2] for s in scores]) * rpm)
    np.testing.assert_allclose([row["Measurements:variances"][1] for _, row in speed], (2 * SIGMA * rpm) ** 2)
    assert np.nanmin(lowest) == pytest.approx(predicted.min() - 2 * SIGMA * rpm), "an axis fits all of the band"
    assert np.nanmax(highest) == pytest.approx(predicted.max() + 2 * SIGMA * rpm)
    names = styles_of(tmp_path / "view.rrd", "/tray1/fan_2/speed", "Measurements:names")
    assert names == ["measured (rpm)", *["twin ± 2σ (rpm)"] * 3]
    outside = np.concatenate([score.outside[:, 2] for score in scores])
    assert len(rows["/tray1/fan_2/outside"]) == np.count_nonzero(outside)
    states = [row["StateChange:state"][0] for _, row in rows["/tray1/state/fan_2"]]
    assert [name for name, _ in groupby(states)] == ["normal", "suspect", "alarm", "returning", "normal"]
    assert [row["TextLog:level"][0] for _, row in rows["/tray1/log"]] == ["ERROR", "INFO"]
    shown = [row["Scalars:scalars"][0] for _, row in rows["/tray1/supply_voltage_v/fan_1"]]
    known = [value for value in shown if np.isfinite(value)]
    np.testing.assert_allclose(known, np.concatenate(volts[half:])[:, 1], err_msg="from its first sample on")
    assert not any("temperature_c" in path for path in rows)


def test_an_existing_view_is_not_overwritten_and_a_file_that_cannot_be_written_is_a_one_line_error(
    tmp_path: Path,
) -> None:
    (tmp_path / "view.rrd").write_bytes(b"earlier")
    for _ in range(2):
        build(context(tmp_path)).core.close()
    assert (tmp_path / "view.rrd").read_bytes() == b"earlier"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["view-2.rrd", "view-3.rrd", "view.rrd"]
    with pytest.raises(StageError, match="cannot write the view") as caught:
        build(context(tmp_path, file="view.rrd/view.rrd"))
    assert "\n" not in str(caught.value)


def test_live_viewers_are_served_on_the_loopback_only_and_a_second_shard_takes_another_port(tmp_path: Path) -> None:
    port = free_port()
    live = context(tmp_path, grpc_port=port)
    core = build(live).core
    with socket.create_connection(("127.0.0.1", port), timeout=5):
        listening = Path("/proc/net/tcp")
        if listening.exists():
            locals_ = [line.split()[1] for line in listening.read_text().splitlines()[1:] if line.split()[3] == "0A"]
            assert f"0100007F:{port:04X}" in locals_
            assert f"00000000:{port:04X}" not in locals_
    shards = [replace(live, instance=f"{number}-of-2", shard_number=number) for number in (1, 2)]
    taken = f"port {port} on 127.0.0.1 is taken"
    assert [any(taken in problem for problem in check(shard)) for shard in shards] == [True, False]
    with pytest.raises(
        StageError, match=rf"^viewer\.grpc_port: {taken} .*; set another one, or viewer\.grpc_port = 0$"
    ):
        build(context(tmp_path / "other", grpc_port=port))
    assert not (tmp_path / "other").exists(), "no file was begun"
    core.close()
