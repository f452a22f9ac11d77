"""A recorder that is killed under load: every part is readable, and what is missing is counted to the message."""

from __future__ import annotations

import pytest

from fantwin.schemas.topics import BY_NAME
from tests.support.killed_recorder import Kills, Outcome

pytestmark = [pytest.mark.slow, pytest.mark.real_time]


def outcome(folder, endpoint, history: int) -> Outcome:
    kills = Kills(folder, endpoint, trays=1, fans=8, history=history)
    try:
        return kills.run(2, seed=1)
    finally:
        kills.close()


def test_messages_that_the_bus_still_holds_are_not_lost(tmp_path, endpoint):
    found = outcome(tmp_path, endpoint, history=BY_NAME["raw"].history)
    assert found.unreadable == []
    assert found.recorded > 500
    assert (found.missing, found.counted_missing, found.repeated) == (0, 0, 0)


def test_messages_that_the_bus_no_longer_holds_are_counted_as_missing(tmp_path, endpoint):
    found = outcome(tmp_path, endpoint, history=4)
    assert found.unreadable == []
    assert found.missing == found.counted_missing > 100
    assert found.repeated == 0
