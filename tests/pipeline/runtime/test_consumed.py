"""Reports of what a session has consumed: few, and the outputs between two of them follow from both."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fantwin.pipeline.runtime.publishing import PERIOD_NS, ConsumedReports
from fantwin.schemas.header import Header, InputPosition
from fantwin.schemas.messages import Consumed, Grid
from fantwin.schemas.streams import continues
from tests.support.made_messages import filled

STEP_NS = 1_000_000_000


class Resampler:
    """Makes a grid of two samples of each raw message, as the runner would publish it."""

    def __init__(self) -> None:
        self.reports = ConsumedReports()
        self.grids: list[Grid] = []
        self.reported: list[Consumed] = []
        self._position: InputPosition | None = None

    def takes(self, producer: str, sequence: int) -> None:
        self._position = InputPosition.after(self._position, "raw", Header(producer, sequence, "a"))
        self._puts_out(self._position)

    def waits(self) -> None:
        """A timer makes it go on without input."""
        if self._position:
            self._puts_out(replace(self._position, from_timer=True))

    def _puts_out(self, position: InputPosition) -> None:
        header = Header("resampler-1", len(self.grids), "a", position)
        t_ns = np.array([0, 1]) + len(self.grids) * STEP_NS
        grid = filled(Grid, 2, 1, header=header, period_ns=1, t_ns=t_ns)
        self.grids.append(grid)
        self.reported += self.reports.after("grid", grid)


@settings(deadline=None)
@given(events=st.lists(st.sampled_from(["next", "next", "next", "next", "gap", "restart", "timer"]), max_size=60))
def test_between_two_reports_nothing_is_missing_and_no_timer_has_acted(events):
    stage, life, sequence = Resampler(), 0, 0
    for event in events:
        life += event == "restart"
        sequence = 0 if event == "restart" else sequence + 1 + (event == "gap")
        if event == "timer":
            stage.waits()
        else:
            stage.takes(f"acquisition-{life}", sequence)
    stage.reported += stage.reports.last()
    numbers = [report.header.sequence for report in stage.reported]
    assert numbers == sorted(set(numbers))
    assert not stage.grids or {0, len(stage.grids) - 1} <= set(numbers)
    for report in stage.reported:
        grid = stage.grids[report.header.sequence]
        assert (report.header, report.topic) == (grid.header, "grid")
        assert (report.first_t_ns, report.t_ns) == (grid.t_ns[0], grid.t_ns[-1])
    for one, other in pairwise(stage.reported):
        between = stage.grids[one.header.sequence + 1 : other.header.sequence]
        positions = [each.header.input_position for each in between]
        assert not any(position.from_timer for position in positions if position)
        chain = [one.header.input_position, *positions, other.header.input_position]
        pairs = list(pairwise(chain))
        assert not between or all(continues(before, after) for before, after in pairs if before and after)
        assert other.t_ns - one.t_ns <= PERIOD_NS


def test_a_run_without_a_break_is_reported_each_two_minutes():
    stage = Resampler()
    for sequence in range(250):
        stage.takes("acquisition-0", sequence)
    assert [report.header.sequence for report in stage.reported] == [0, 120, 240]
    assert [report.header.sequence for report in stage.reports.last()] == [249]
    assert stage.reports.last() == [], "the end is reported once"
