"""What a device has counted since its frame before, also where it has restarted or its uptime has wrapped."""

from __future__ import annotations

import pytest

from fantwin.pipeline.sources.serial.source import DeviceCounterSteps
from fantwin.schemas.wire import UINT32, DeviceCounters

AT_100_HZ_S = UINT32 // 100
"""uptime after which the sample number of a device wraps"""


def steps(*frames: tuple[int, tuple[int, ...]]) -> list[int]:
    """The advance of each counter in the last of these frames, each an uptime in seconds and the counters."""
    its = DeviceCounterSteps()
    found = [list(its.steps(DeviceCounters(uptime_s, counts)).values()) for uptime_s, counts in frames]
    return found[-1]


@pytest.mark.parametrize(
    ("last", "now", "advance"),
    [
        pytest.param((70, (50, 0, 7)), (71, (60, 0, 9)), [10, 0, 2], id="it runs on"),
        pytest.param((70, (65_530, 0, 7)), (71, (3, 0, 7)), [9, 0, 0], id="a counter wraps"),
        pytest.param((70, (50, 0, 7)), (0, (60, 0, 9)), [60, 0, 9], id="restart: the uptime is smaller"),
        pytest.param((2, (50, 0, 7)), (3, (1, 0, 0)), [1, 0, 0], id="restart: only the counters show it"),
        pytest.param((2, (50, 0, 7)), (2, (1, 0, 0)), [1, 0, 0], id="restart within a second"),
        pytest.param((2, (50, 0, 7)), (2, (51, 0, 7)), [1, 0, 0], id="two frames within a second"),
        pytest.param((AT_100_HZ_S - 1, (50, 0, 7)), (0, (51, 0, 7)), [1, 0, 0], id="the uptime wraps"),
        pytest.param((AT_100_HZ_S - 9, (50, 0, 7)), (3, (51, 0, 7)), [1, 0, 0], id="frames before the wrap are lost"),
        pytest.param((UINT32 - 1, (50, 0, 7)), (0, (51, 0, 7)), [1, 0, 0], id="the uptime wraps at 32 bits"),
        pytest.param((AT_100_HZ_S, (50, 0, 7)), (0, (51, 0, 0)), [51, 0, 0], id="restart after years"),
        pytest.param((70, (50, 0, 7)), (71, (60, 0)), [0, 0], id="another number of counters"),
    ],
)
def test_what_is_counted_since_the_frame_before(
    last: tuple[int, tuple[int, ...]], now: tuple[int, tuple[int, ...]], advance: list[int]
) -> None:
    assert steps(last, now) == advance


def test_counters_that_wrapped_while_the_line_was_closed_show_no_restart() -> None:
    its = DeviceCounterSteps()
    its.steps(DeviceCounters(70, (50, 0, 7)))
    its.connection_interrupted()
    assert not any(its.steps(DeviceCounters(90_000, (40, 0, 7))).values())
