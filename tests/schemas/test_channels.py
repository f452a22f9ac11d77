"""What is measured beside command and speed, as it is shown."""

from __future__ import annotations

import pytest

from fantwin.schemas.channels import axis_range


@pytest.mark.parametrize(
    ("lowest", "highest", "axis"),
    [
        pytest.param(11.99, 12.01, (11.7598, 12.2402), id="noise"),
        pytest.param(10.0, 20.0, (9.5, 20.5), id="a change"),
        pytest.param(-20.2, -19.8, (-20.404, -19.596), id="below zero"),
    ],
)
def test_noise_looks_small_and_a_change_fills_the_axis(
    lowest: float, highest: float, axis: tuple[float, float]
) -> None:
    assert axis_range(lowest, highest) == pytest.approx(axis)
