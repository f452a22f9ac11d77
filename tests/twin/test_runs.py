"""Valid and invalid runs, and how a run is cut."""

from dataclasses import replace

import numpy as np
import pytest

from fantwin.schemas.tacho import Tacho
from fantwin.twin.errors import TwinError
from fantwin.twin.runs import Run, common_tacho, starting_speed_rad_s


def ramp(times: list[float]) -> Run:
    t_s = np.array(times)
    return Run("ramp", t_s, np.ones_like(t_s), t_s)


def test_a_run_splits_at_a_long_gap_and_leaves_out_a_lone_sample() -> None:
    pieces = ramp([0.0, 0.1, 0.2, 0.3, 5.0, 9.0, 9.1]).split_at_gaps(1.0)
    assert [piece.t_s.tolist() for piece in pieces] == [[0.0, 0.1, 0.2, 0.3], [9.0, 9.1]]


def test_a_slice_of_time_and_of_a_fan_keeps_the_rest() -> None:
    tachos = tuple(Tacho(kind="count", window_s=window_s) for window_s in (1.0, 0.5))
    run = Run("two", np.arange(4.0), np.arange(8.0).reshape(4, 2), np.zeros((4, 2)), tachos)
    part = run.between(1.0, 3.0).fan(1)
    np.testing.assert_array_equal(part.command, [[3.0], [5.0]])
    assert part.tacho == tachos[1:]


def test_runs_that_are_measured_differently_are_not_mixed() -> None:
    one, other = (replace(ramp([0.0, 1.0]), tacho=(Tacho(kind="count", window_s=window_s),)) for window_s in (1.0, 0.5))
    assert common_tacho([one, one]) == one.tacho
    with pytest.raises(TwinError, match="count over 1 s.* and by count over 0.5 s.*measured alike"):
        common_tacho([one, other])


@pytest.mark.parametrize(
    ("t_s", "command", "speed", "words"),
    [
        ([0.0, 1.0, 0.5], [1, 1, 1], [1, 1, 1], "time does not increase at sample 2"),
        ([0.0, 1.0], [1, np.nan], [1, 1], "is not a number"),
        ([0.0, 1.0], [1, 1], [1, np.inf], "infinite"),
        ([0.0, 1.0], [1, 1, 1], [1, 1], "disagree"),
        ([0.0], [1], [1], "give 2 samples or more"),
    ],
)
def test_a_bad_run_is_refused_in_one_line(t_s: list, command: list, speed: list, words: str) -> None:
    with pytest.raises(TwinError, match=words) as refusal:
        Run("bad", np.array(t_s), np.array(command), np.array(speed))
    assert "\n" not in str(refusal.value)


def test_the_starting_speed_skips_missing_samples() -> None:
    speed = np.array([[np.nan, np.nan], [2.0, np.nan], [4.0, np.nan], [4.0, np.nan], [2.0, 8.0], [3.0, 9.0]])
    np.testing.assert_array_equal(starting_speed_rad_s(speed), [3.0, 8.5])
