"""Which fans of a fleet have a plot."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fantwin.pipeline.outputs.rerun.plot_places import FleetPlots, PlotPlaces
from fantwin.pipeline.site.fleet import Fan

A, B, C, D = (Fan("tray1", number) for number in range(4))
ASKED = Fan("tray2", 0)
HOLD_NS = 60


def test_a_plot_stays_for_a_while_after_the_alarm_and_then_goes() -> None:
    places = PlotPlaces(FleetPlots(for_alarms=2), HOLD_NS)
    places.update([A], 0)
    places.update([A], 10)
    places.update([], 10 + HOLD_NS)
    assert places.place(A) == 1
    places.update([], 11 + HOLD_NS)
    assert places.place(A) is None


def test_a_new_alarm_takes_the_plot_whose_alarm_has_been_over_for_longest_and_never_that_of_another_alarm() -> None:
    places = PlotPlaces(FleetPlots(for_alarms=2), HOLD_NS)
    places.update([A, B], 0)
    places.update([B], 1)
    places.update([C, D], 2)
    assert places.taken() == {C: 1, D: 2}, "A was over first"
    places.update([A, C, D], 3)
    assert places.taken() == {C: 1, D: 2}, "A is worse, but comes later"


@given(
    st.lists(st.tuples(st.lists(st.sampled_from([A, B, C, D, ASKED]), unique=True), st.integers(0, 40)), max_size=30),
    st.integers(0, 3),
)
def test_no_plot_is_shared_or_invented_and_no_alarm_loses_its_own(steps: list, for_alarms: int) -> None:
    plots = FleetPlots([ASKED], for_alarms)
    places, now_ns, before, alarms_before = PlotPlaces(plots, HOLD_NS), 0, {}, set()
    for in_alarm, later_ns in steps:
        now_ns += later_ns + 1
        places.update(in_alarm, now_ns)
        taken = places.taken()
        assert len(set(taken.values())) == len(taken) and set(taken.values()) <= set(range(1, plots.count + 1))
        kept = {fan for fan in alarms_before & set(in_alarm) if fan in before}
        assert all(taken[fan] == before[fan] for fan in kept)
        waiting = set(in_alarm) - set(taken)
        assert not waiting or len(taken) == plots.count
        before, alarms_before = taken, set(in_alarm)
