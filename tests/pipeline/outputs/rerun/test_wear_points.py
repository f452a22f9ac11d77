"""The wear of fans in the view."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from fantwin.pipeline.outputs.rerun.rerun_wear import wear_points
from fantwin.schemas.messages import ScorerSnapshot
from tests.support.score_data import START_NS
from tests.support.wear_data import LOSS, worn_snapshot

FANS, WORN = 3, 2


@pytest.fixture(scope="module")
def snapshot() -> ScorerSnapshot:
    return worn_snapshot("tray1", FANS, WORN, START_NS)


def test_the_points_of_every_fan_are_read_as_they_are_shown(snapshot: ScorerSnapshot) -> None:
    found = wear_points(snapshot)
    assert [each.fan for each in found] == [0, 1, 2]
    wear = json.loads(snapshot.state_json)["wear"]
    worn, series = found[WORN], wear["series"][WORN]
    assert worn.t_ns.tolist() == series["t_ns"]
    assert worn.change[-1] == pytest.approx(-100.0 * LOSS, abs=1.5) and abs(worn.change[0]) < 1.0, "per cent"
    assert worn.change[-1] == pytest.approx(100.0 * wear["fans"][WORN]["change"], abs=1.0)
    np.testing.assert_allclose(worn.std_error, 100.0 * np.array(series["std_error"]))
    assert len(worn.after(int(worn.t_ns[-3])).t_ns) == 2


def test_a_snapshot_without_wear_or_of_an_unknown_version_has_no_points(snapshot: ScorerSnapshot) -> None:
    for text in ("{}", '{"wear": {"fans": [{}], "series": [{}]}}', '{"wear": {"fans": 3}}', "not JSON"):
        assert wear_points(replace(snapshot, state_json=text)) == []
