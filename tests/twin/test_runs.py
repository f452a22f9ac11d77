"""Invalid runs are refused, and valid ones cut at their gaps."""

import numpy as np
import pytest

from fantwin.twin.errors import TwinError
from fantwin.twin.runs import Run


def ramp(times: list[float]) -> Run:
    t_s = np.array(times)
    return Run("ramp", t_s, np.ones_like(t_s), t_s)


def test_a_run_splits_at_a_long_gap_and_leaves_out_a_lone_sample() -> None:
    pieces = ramp([0.0, 0.1, 0.2, 0.3, 5.0, 9.0, 9.1]).split_at_gaps()
    assert [piece.t_s.tolist() for piece in pieces] == [[0.0, 0.1, 0.2, 0.3], [9.0, 9.1]]


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
