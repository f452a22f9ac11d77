"""Where the fans of a fleet lie on its map."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fantwin.pipeline.outputs.rerun.fleet_map import CHARACTER_PX, LABEL_HEIGHT_PX, MAP_PX, fleet_map


@given(st.lists(st.integers(1, 1024), min_size=1, max_size=40), st.integers(1, 12))
def test_every_fan_has_a_cell_of_its_own_within_the_block_of_its_tray(fans: list[int], length: int) -> None:
    shown = fleet_map(["x" * length] * len(fans), fans)
    of_tray = np.repeat(np.arange(len(fans)), fans)
    left_top, size = shown.blocks[of_tray, :2], shown.blocks[of_tray, 2:]
    inside = shown.cells - left_top
    assert ((inside > 0) & (inside < size)).all()
    assert len(np.unique(np.round(shown.cells, 6), axis=0)) == sum(fans)
    assert (gaps(shown.blocks, shown.blocks) + np.eye(len(fans)) * 1e6).min() >= 1.0, "no two blocks touch"


@pytest.mark.parametrize("fans", [[8] * 10, [64] * 157, [1024] * 10])
def test_the_map_fills_a_window_and_its_names_do_not_touch(fans: list[int]) -> None:
    names = [f"hall1-{number}" for number in range(len(fans))]
    shown = fleet_map(names, fans)
    used = shown.width * shown.height * shown.cell_px**2 / (MAP_PX[0] * MAP_PX[1])
    assert 0.7 < used <= 1.0
    width = np.array([len(names[tray]) for tray in shown.label_trays]) * CHARACTER_PX / shown.cell_px
    left_top = shown.labels - np.stack([width / 2, np.zeros_like(width)], axis=1)
    boxes = np.concatenate([left_top, width[:, None], np.full_like(width, LABEL_HEIGHT_PX / shown.cell_px)[:, None]], 1)
    between_names = gaps(boxes, boxes) + np.eye(len(boxes)) * 1e6
    assert between_names.min() * shown.cell_px > -1.0
    assert gaps(boxes, shown.blocks).min() * shown.cell_px > -1.0


def gaps(some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """How far rectangles (left, top, width, height) are apart, each of some from each of the others; negative where
    they overlap."""
    a, b = some[:, None], others[None]
    return np.maximum(a[..., :2] - (b[..., :2] + b[..., 2:]), b[..., :2] - (a[..., :2] + a[..., 2:])).max(axis=-1)


def test_where_names_do_not_fit_each_row_is_named_at_its_left_after_its_first_tray() -> None:
    shown = fleet_map(["a rather long name of a tray"] * 157, [64] * 157)
    assert [shown.blocks[tray, 0] for tray in shown.label_trays] == [0.0] * len(shown.label_trays)
    assert (shown.labels[:, 0] < 0).all() and 1 < len(shown.label_trays) < 30
