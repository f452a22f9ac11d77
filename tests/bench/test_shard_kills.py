"""bench.fleet.shard_kills: shards that are killed lose nothing, and their alarms are those of a site left alone."""

from __future__ import annotations

import pytest

from bench.fleet.fed_trays import Load
from bench.fleet.shard_kills import STAGES, Kills, run

pytestmark = [pytest.mark.slow, pytest.mark.real_time]


def test_shards_that_are_killed_under_load_lose_nothing_and_raise_and_forget_no_alarm(tmp_path):
    kills = Kills(6, shards=2, seed=2, stages=STAGES)
    found, killed = run(Load(2, 45.0), kills, tmp_path)
    assert sum(killed.values()) == 6
    assert set(killed) <= set(STAGES)
    assert found.alarms == 6
    assert found.scored > 12_900
    assert (found.not_recorded, found.not_scored) == (0, 0)
    assert found.alarms_are_right, found.notes()
