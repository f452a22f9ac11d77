"""A recorder that is killed under load: every part is readable, and what is missing is counted to the message.

That nothing is lost which the bus still holds: tests/system/test_site.py.
"""

from __future__ import annotations

import pytest

from bench.runtime.killed_recorder import Kills

pytestmark = [pytest.mark.slow, pytest.mark.real_time]


def test_messages_that_the_bus_no_longer_holds_are_counted_as_missing(tmp_path, endpoint):
    kills = Kills(tmp_path, endpoint, trays=1, fans=8, history=4)
    try:
        found = kills.run(2, seed=1)
    finally:
        kills.close()
    assert found.unreadable == []
    assert found.missing == found.counted_missing > 100
    assert found.repeated == 0
