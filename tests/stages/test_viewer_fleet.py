"""The viewer with more fans than it can draw: plots of a few."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.rerun.fleet_view import FleetView
from fantwin.pipeline.outputs.rerun.viewer_core import FLUSH_PERIOD_NS, ViewerCore
from fantwin.pipeline.runtime.stage import StageError
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.messages import Alarm, Score
from fantwin.stages.viewer import ViewerConfig, build, check, topics_read
from tests.support.drawn_fleets import TRAYS, context, last_t_ns, messages_of, play
from tests.support.drawn_views import FakeSink, rows_of, sent, styles_of
from tests.support.score_data import START_NS, STEP_NS, made_up_tray

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
    play(core, messages)
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
    play(core, [m for m in messages_of() if m.header.tray != "tray2" or last_t_ns(m) < START_NS + 10_000_000_000])
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
    core = build(context(tmp_path, 2, fans)).core
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
    core = build(context(tmp_path, 3, 3, show=("tray1/0",))).core
    assert isinstance(core, ViewerCore)
    play(core, [with_supply(each) if each.header.tray == "tray2" else each for each in messages_of()])
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
        ("tray1/x", 'viewer.show: \'tray1/x\' is no fan; write "tray/number", for example "tray1/0"'),
        ("tary1/0", "viewer.show: 'tary1/0': no tray called 'tary1'; did you mean 'tray1'?"),
        ("tray1/3", "viewer.show: 'tray1/3': tray1 has fans 0 to 2"),
    ],
)
def test_a_fan_to_show_that_does_not_exist_is_a_one_line_error(tmp_path: Path, name: str, problem: str) -> None:
    wrong = context(tmp_path, 1, 3, show=("tray1/1", name))
    assert check(wrong) == [problem]
    with pytest.raises(StageError) as caught:
        build(wrong)
    assert str(caught.value) == problem and list(tmp_path.iterdir()) == []
