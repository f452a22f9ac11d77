"""What the viewer draws of a few fans, and of a fleet the fans that are looked at or have an alarm."""

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
from fantwin.pipeline.outputs.rerun.fleet_view import FleetView
from fantwin.pipeline.outputs.rerun.viewer_core import FLUSH_PERIOD_NS, REPEAT_STATES_NS, SAMPLES_HELD, ViewerCore
from fantwin.pipeline.runtime.stage import StageError
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.messages import Alarm, Score
from fantwin.schemas.units import RAD_S_PER_UNIT
from fantwin.stages.viewer import ViewerConfig, build, check, topics_read
from tests.support.drawn_fleets import TRAYS, last_t_ns, messages_of
from tests.support.drawn_fleets import context as context_of_trays
from tests.support.drawn_fleets import play as play_to_fleet
from tests.support.drawn_views import LATER_NS, FakeSink, context, play, rows_of, sent, styles_of
from tests.support.ports import free_port
from tests.support.score_data import SIGMA, START_NS, STEP_NS, made_up_tray


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
    assert sink.lane(1) == [(0, "normal"), (2.5, "unknown: samples are missing"), (3, "normal")]
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


HOLD_S, WINDOW_S = 3, 4


def fleet_core(sink: FakeSink, *, show: tuple[Fan, ...] = (), for_alarms: int = 2, hold_s: int = HOLD_S) -> ViewerCore:
    trays = [TrayConfig(name=name, fans=3) for name in TRAYS]
    fleet = FleetView(trays, show, for_alarms, hold_s * 1_000_000_000, WINDOW_S * 1_000_000_000)
    return ViewerCore("site", trays, sink, fleet)


def drawn(sink: FakeSink, fan: Fan) -> tuple[np.ndarray, np.ndarray]:
    """Times and measured speeds that were drawn of a fan."""
    traces = [trace for trace in sink.traces if trace.tray == fan.tray and fan.number in trace.fan_numbers]
    columns = [list(trace.fan_numbers).index(fan.number) for trace in traces]
    measured = [trace.measured[:, column] for trace, column in zip(traces, columns, strict=True)]
    return np.concatenate([trace.t_ns for trace in traces]), np.concatenate(measured)


def test_only_the_fan_in_alarm_is_drawn_with_what_was_before_and_for_a_while_after() -> None:
    sink, messages = FakeSink(), messages_of()
    core = fleet_core(sink)
    play_to_fleet(core, messages)
    faulty = Fan("tray2", 2)
    assert {(trace.tray, *trace.fan_numbers) for trace in sink.traces} == {("tray2", 2)}
    t_ns, measured = drawn(sink, faulty)
    assert (np.diff(t_ns) > 0).all(), "each sample once, in order"
    seconds = (t_ns - START_NS) / 1e9
    begin_s = 8.5  # of the alarm
    before = seconds[seconds < begin_s]
    assert begin_s - WINDOW_S <= before[0] <= begin_s - WINDOW_S + 0.5 and np.allclose(np.diff(before), 0.5, atol=0.11)
    after = seconds[seconds >= begin_s + 0.1]
    assert np.allclose(np.diff(after), STEP_NS / 1e9), "from then on every sample"
    assert sink.shown == [(faulty,), ()]
    assert 14.5 + HOLD_S <= seconds[-1] <= 14.5 + HOLD_S + 1
    recorded = {int(t): s for m in messages if isinstance(m, Score) and m.header.tray == "tray2" for t, s in rows(m)}
    np.testing.assert_allclose(measured, [recorded[int(t)] for t in t_ns])


def rows(score: Score) -> list[tuple[int, float]]:
    return list(zip(score.t_ns.tolist(), score.measured_speed_rad_s[:, 2].tolist(), strict=True))


def test_a_tray_that_sends_no_more_becomes_silent_and_its_alarm_gives_up_its_plot() -> None:
    sink = FakeSink()
    core = fleet_core(sink)
    play_to_fleet(
        core, [m for m in messages_of() if m.header.tray != "tray2" or last_t_ns(m) < START_NS + 10_000_000_000]
    )
    assert sink.shown == [(Fan("tray2", 2),), ()]


def test_scores_that_do_not_fit_or_decode_are_counted_and_reported_until_they_do() -> None:
    sink = FakeSink()
    core = ViewerCore("site", [TrayConfig(name="tray1", fans=3)], sink)

    def score(tray: str = "tray1", fans: int = 3) -> Any:
        return sent(made_up_tray(tray=tray, fans=fans, seconds=0.1, faulty_fan=None, gap_fan=None)[0][0])

    damaged = score()
    damaged.payload += b"\xff"
    for number, message in enumerate((score("elsewhere"), damaged, score(fans=2)), 1):
        core.step(message)
        core.tick(START_NS + number * FLUSH_PERIOD_NS)
    counts = core.counters()
    assert (counts["unknown_tray"], counts["refused_scores"], sink.traces) == (1, 2, [])
    assert core.problem() == "scores have 2 fans, [[tray]] tray1 has fans = 3: correct `fans`"
    core.step(score())
    core.tick(START_NS + 4 * FLUSH_PERIOD_NS)
    assert core.problem() == "" and len(sink.traces) > 0


@pytest.mark.parametrize(("fans", "is_fleet"), [(32, False), (33, True)])
def test_a_site_of_more_than_64_fans_is_a_fleet(tmp_path: Path, fans: int, is_fleet: bool) -> None:
    core = build(context_of_trays(tmp_path, 2, fans)).core
    for score in made_up_tray(fans=fans, seconds=0.2, faulty_fan=None)[0]:
        core.step(sent(score))
        core.tick(last_t_ns(score))
    core.close()
    rows = rows_of(tmp_path / "view.rrd")
    assert ("/tray1/fan_0/speed" in rows) == (not is_fleet)
    trays = [TrayConfig(name="a", fans=fans), TrayConfig(name="b", fans=fans)]
    assert ("snapshot" in topics_read(ViewerConfig(), trays)) == (not is_fleet), "wear is not drawn of a fleet"


def with_supply(message: Score | Alarm) -> Score | Alarm:
    if isinstance(message, Alarm):
        return message
    return replace(message, supply_voltage_v=np.full(message.score.shape, 12.5, np.float32))


def test_the_file_of_a_fleet_has_the_fans_that_were_drawn_and_one_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fantwin.pipeline.outputs.rerun.fleet_view.FLEET_ABOVE", 3)
    monkeypatch.setattr("fantwin.pipeline.outputs.rerun.fleet_view.HOLD_S", HOLD_S)
    core = build(context_of_trays(tmp_path, 3, 3, show=("tray1/0",))).core
    assert isinstance(core, ViewerCore)
    play_to_fleet(core, [with_supply(each) if each.header.tray == "tray2" else each for each in messages_of()])
    core.close()
    path = tmp_path / "view.rrd"
    rows = rows_of(path)
    assert {entity for entity in rows if entity.endswith("/speed")} == {"/tray1/fan_0/speed", "/tray2/fan_2/speed"}
    assert styles_of(path, "/tray2/score/page_2", "SeriesLines:names") == ["score", "limit", "limit"]
    assert {len(row["Scalars:scalars"]) for _, row in rows["/tray2/score/page_2"]} == {3}, "of this fan alone"
    assert {row["Scalars:scalars"][0] for _, row in rows["/tray2/supply_voltage_v/fan_2"]} == {12.5}
    states = [row["StateChange:state"][0] for _, row in rows["/tray2/state/fan_2"]]
    assert states[0] in ("normal", "suspect") and "alarm" in states
    texts = [row["TextLog:text"][0] for _, row in rows["/fleet/log"]]
    assert texts[0].startswith("22:13:28  tray2 fan 2: alarm raised") and len(texts) == 2


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("x", 'viewer.show: \'x\' is no fan; write "tray/fan", for example "tray1/0"'),
        (
            "tray1/x",
            "viewer.show: 'tray1/x': tray tray1: no fan called 'x': the fans have no names; give a number, counted "
            "from 0",
        ),
        ("tary1/0", "viewer.show: 'tary1/0': no tray called 'tary1'; did you mean 'tray1'?"),
        ("tray1/3", "viewer.show: 'tray1/3': fan 3: tray tray1 has fans 0 to 2"),
    ],
)
def test_a_fan_to_show_that_does_not_exist_is_a_one_line_error(tmp_path: Path, name: str, problem: str) -> None:
    wrong = context_of_trays(tmp_path, 1, 3, show=("tray1/1", name))
    assert check(wrong) == [problem]
    with pytest.raises(StageError) as caught:
        build(wrong)
    assert str(caught.value) == problem and list(tmp_path.iterdir()) == []
