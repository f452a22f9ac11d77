"""bench.fleet.viewer_cost: what the made-up fleet sends reaches the viewer, and each part has its cost."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.detection.plant import START_NS
from bench.fleet.fleet_scores import ALARM_S, DELAY_S, FleetScores
from schemas.codec import decode
from schemas.enums import FanState
from schemas.envelope import Envelope
from schemas.messages import Alarm, Score


@pytest.mark.parametrize("block_s", [0.05, 1.0])
def test_a_fleet_sends_every_sample_once_and_its_alarms_where_its_states_say_so(block_s: float) -> None:
    fleet = FleetScores(10, fans_of_tray=4, block_s=block_s)
    fleet.add_excursions(1, 1.0, 1.0)
    sent = [message for second in range(3) for message in fleet.second(second)]
    scores = [decode(Score, message.payload) for message in sent if isinstance(message, Envelope)]
    assert [tray.fans for tray in fleet.trays] == [4, 4, 2]
    assert sum(len(score.t_ns) * score.fans for score in scores) == 3 * 100 * 10
    assert [s.header.sequence for s in scores if s.header.tray == "rack001"] == list(range(round(3 / block_s)))
    (alarm,) = (message for message in sent if isinstance(message, Alarm))
    assert alarm.onset_t_ns == START_NS + 1_000_000_000 and DELAY_S + ALARM_S > 2.0
    first = min(int(score.t_ns[(score.state == FanState.ALARM).any(axis=1)][0]) for score in scores if in_alarm(score))
    assert first == alarm.t_ns


def test_the_cost_on_the_bus_is_that_of_the_whole_fleet(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from bench.fleet.viewer_on_bus import cost_on_bus  # noqa: PLC0415  needs the extra `view`

    cost = cost_on_bus(70, 2, 0.05, 1, tmp_path)
    assert cost["fans"] == 70 and 0.0 < cost["rate"] < 1.1 and cost["% of a core"] > 0.0
    assert cost["dropped"] == 0 and (tmp_path / "runs" / "view.rrd").stat().st_size > 0


def in_alarm(score: Score) -> bool:
    return bool((score.state == FanState.ALARM).any())


def test_each_part_has_its_cost(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from bench.fleet.viewer_cost import cost_of  # noqa: PLC0415  needs the extra `view`

    fleet = FleetScores(80, fans_of_tray=8, block_s=0.1)
    fleet.add_excursions(2, 1.0, 1.5)
    cost = cost_of(fleet, 4, tmp_path)
    assert set(cost.seconds) == {"receive", "step", "tick", "close"} and min(cost.seconds.values()) > 0.0
    assert cost.file_bytes > 10_000 and cost.peak_mb > 10.0
    assert 2 * 150 < cost.counters["samples_drawn"] < 4 * 100 * 2
