"""The wear of fans in the view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.viewing.wear_points import PARAMETERS, wear_points
from scoring.wear.wear_monitor import UNITS
from tests.stages.test_viewer import FLUSH_PERIOD_NS, FakeSink, core_of
from tests.support.score_data import START_NS
from tests.support.wear_data import POINTS, worn_snapshot


def test_every_parameter_of_every_fan_is_read_as_it_is_shown() -> None:
    assert set(PARAMETERS) == set(UNITS)
    found = wear_points(worn_snapshot("tray1", 3, 2, START_NS))
    assert {(each.fan, each.parameter) for each in found} == {(fan, name) for fan in range(3) for name in UNITS}
    drag = next(each for each in found if (each.fan, each.parameter) == (2, "drag"))
    assert len(drag.t_ns) == POINTS and drag.t_ns[-1] == START_NS
    assert drag.change[-1] == 12.0 and drag.change[0] == 0.0, "per cent"
    np.testing.assert_allclose(drag.std_error, 0.121)
    assert len(drag.after(int(drag.t_ns[-3])).t_ns) == 2


def test_a_snapshot_without_wear_or_of_an_unknown_version_has_no_points() -> None:
    for text in ("{}", '{"wear": {"fans": [{"parameters": {}}]}}', '{"wear": {"fans": 3}}', "not JSON"):
        assert wear_points(replace(worn_snapshot("tray1", 1, 0, START_NS), state_json=text)) == []


def test_the_wear_is_drawn_once_with_each_snapshot() -> None:
    sink = FakeSink()
    core = core_of(sink)
    for number in range(4):
        if number % 2 == 0:
            core.step(worn_snapshot("tray1", 3, 2, START_NS + number))
        core.tick((number + 1) * FLUSH_PERIOD_NS)
    assert len(sink.wear) == 2 * 3 * len(UNITS) and {tray for tray, _ in sink.wear} == {"tray1"}
