"""Messages side by side, and apart again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fantwin.schemas.codec import encode
from fantwin.schemas.messages import Grid
from fantwin.schemas.side_by_side import apart, present_columns, side_by_side


def grid(first: int, fans: int = 3, samples: int = 4) -> Grid:
    values = np.arange(first, first + samples * fans, dtype=np.float64).reshape(samples, fans)
    return Grid(
        fans=fans,
        period_ns=10,
        t_ns=np.arange(1, samples + 1) * 10 + first,
        command=values,
        speed_rad_s=values + 0.5,
        valid=values % 2 == 0,
        invalid_reason=(values % 3).astype(np.uint8),
        reading_missing=values % 5 == 0,
    )


def test_messages_side_by_side_are_the_same_apart() -> None:
    grids = [grid(100 * k) for k in range(3)]
    joint = side_by_side(grids)
    assert joint.fans == 9
    assert joint.command.shape == (4, 9)
    np.testing.assert_array_equal(joint.t_ns, grids[0].t_ns)
    np.testing.assert_array_equal(joint.command[:, 3:6], grids[1].command)
    found = apart(joint, [each.t_ns for each in grids])
    assert [encode(each) for each in found] == [encode(each) for each in grids]


def test_an_optional_column_is_present_or_not() -> None:
    whole = grid(0)
    without = replace(whole, reading_missing=np.zeros(0, np.bool_))
    assert present_columns(whole) == ("reading_missing",)
    assert present_columns(without) == ()
    (one, other) = apart(side_by_side([without, without]), [without.t_ns, without.t_ns])
    assert encode(one) == encode(other) == encode(without)
