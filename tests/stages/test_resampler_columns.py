"""stages.resampler: supply voltage, current and temperature on the grid, without invented values."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fantwin.schemas.blocks import cut, join
from fantwin.schemas.messages import Array, Grid, Raw
from fantwin.schemas.side_by_side import present_columns
from fantwin.stages.resampler import ResamplerCore
from tests.stages.test_resampler import FIXED, NAN, at, raw


def grid_of(messages: Iterable[Raw], fans: int = 1) -> list[Grid]:
    core = ResamplerCore(fans, FIXED)
    return [grid for message in messages for grid in core.step(message)] + core.close()


def line(times_s: Sequence[float], **columns: Sequence[float]) -> Raw:
    given: dict[str, Array] = {name: np.array(values, np.float32)[:, np.newaxis] for name, values in columns.items()}
    message: dict[str, Any] = {**given}
    return replace(raw(at(*times_s), np.full(len(times_s), 100.0)), **message)


def test_values_are_interpolated_between_samples_held_before_one_that_has_none_and_no_gap_is_bridged() -> None:
    message = line(
        [0.0, 0.02, 0.04, 0.06],
        supply_voltage_v=[12.0, 11.0, 12.0, 13.0],
        temperature_c=[20.0, NAN, NAN, 22.0],
    )
    (grid,) = grid_of([message])
    np.testing.assert_allclose(grid.supply_voltage_v[:, 0], [12.0, 11.5, 11.0, 11.5, 12.0, 12.5, 13.0])
    np.testing.assert_array_equal(grid.temperature_c[:, 0], [20.0, 20.0, NAN, NAN, NAN, NAN, 22.0])
    assert grid.current_a.size == 0
    assert grid.supply_voltage_v.dtype == np.float32
    (grid,) = grid_of([line([0.0, 0.01, 0.02, 0.30, 0.31], supply_voltage_v=[12.0, 12.0, 12.0, 11.0, 11.0])])
    known = np.isfinite(grid.supply_voltage_v[:, 0])
    np.testing.assert_array_equal(known, grid.valid[:, 0])
    assert 0 < known.sum() < len(known)


def test_how_samples_are_divided_into_messages_makes_no_difference(size: int = 3) -> None:
    rng = np.random.default_rng(4)
    times = np.cumsum(rng.uniform(0.002, 0.02, 200))
    volts, amperes = rng.uniform(11, 13, (2, 200))
    message = line(
        times.tolist(), supply_voltage_v=volts.tolist(), current_a=np.where(volts > 12, NAN, amperes).tolist()
    )
    whole = join(grid_of([message]))
    pieces = join(grid_of([cut(message, k, min(k + size, 200)) for k in range(0, 200, size)]))
    for name in ("t_ns", "speed_rad_s", "supply_voltage_v", "current_a"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(pieces, name), err_msg=name)


def test_a_column_that_begins_later_is_in_the_messages_from_then_on() -> None:
    first, second = line([0.0, 0.01, 0.02]), line([0.03, 0.04, 0.05], supply_voltage_v=[12.0, 12.0, 12.0])
    grids = grid_of([first, second, line([0.06, 0.07])])
    assert [present_columns(grid) for grid in grids] == [
        ("reading_missing",),
        *[("reading_missing", "supply_voltage_v")] * 2,
    ]
    assert np.isnan(grids[-1].supply_voltage_v).all()
