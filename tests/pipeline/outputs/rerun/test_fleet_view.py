"""Which fans of a fleet are drawn, and what is kept of its past."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.rerun.fleet_view import FleetView
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.units import NS_PER_S

WINDOW_S = 4
HOLD_NS = 10
ASKED = Fan("tray1", 0)
A, B, C = (Fan("tray1", number) for number in (1, 2, 3))


def view_of(most_in_alarm: int, asked: tuple[Fan, ...] = ()) -> FleetView:
    return FleetView([TrayConfig(name="tray1", fans=3)], asked, most_in_alarm, HOLD_NS, WINDOW_S * NS_PER_S)


def test_a_new_alarm_replaces_the_fan_whose_alarm_has_been_over_for_longest() -> None:
    view = view_of(2)
    for now_ns, in_alarm in ((1, [A, B]), (3, [B]), (5, [C])):
        view.update(in_alarm, now_ns)
    assert view.drawn == (B, C)


@settings(max_examples=30)
@given(
    st.lists(st.tuples(st.integers(0, 15), st.lists(st.sampled_from([ASKED, A, B, C]), unique=True)), max_size=30),
    st.integers(0, 3),
)
def test_a_fan_in_alarm_keeps_its_plot_and_no_other_has_one_for_longer_than_it_is_held(
    steps: list[tuple[int, list[Fan]]], most: int
) -> None:
    view, now_ns, before = view_of(most, (ASKED,)), 0, set[Fan]()
    last_ns: dict[Fan, int] = {}
    for step_ns, in_alarm in steps:
        now_ns += step_ns
        last_ns |= dict.fromkeys(in_alarm, now_ns)
        view.update(in_alarm, now_ns)
        drawn = set(view.drawn)
        assert ASKED in drawn and len(view.drawn) == len(drawn) <= most + 1
        assert before & set(in_alarm) <= drawn, "those in alarm stay"
        assert all(now_ns - last_ns[fan] <= HOLD_NS for fan in drawn - {ASKED})
        assert len(drawn) == most + 1 or set(in_alarm) <= drawn, "and come while there is room"
        before = drawn
