"""Where each fan of a fleet lies on the map: a block of cells for each tray, in rows, in the configuration's order.

The unit of length is the distance between two cells; y points down.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fantwin.schemas.messages import Array

MAP_PX = (1300, 640)
"""about the size of the map in a window of full HD: the layout fits it; a smaller one is scaled down"""
LABEL_HEIGHT_PX, CHARACTER_PX = 22, 7
BETWEEN = 1.2
"""between two blocks"""


@dataclass(frozen=True, eq=False)
class FleetMap:
    """Places on the map.

    Attributes:
        cells: (fans, 2) the middle of each fan's cell, tray after tray.
        blocks: (trays, 4) left, top, width and height of each tray's block.
        labels: (k, 2) where the names of trays are, and whose names they are.
        width, height: of all blocks together.
        cell_px: size of a cell in a window of full HD.
    """

    cells: Array
    blocks: Array
    labels: Array
    label_trays: Sequence[int]
    width: float
    height: float
    cell_px: float


def fleet_map(names: Sequence[str], fans: Sequence[int]) -> FleetMap:
    """The map of trays with these names and numbers of fans (at least one each).

    Each block has the name of its tray above it, if the names fit side by side. Otherwise each row of blocks has the
    name of its first tray at its left.
    """
    blocks = named = _blocks(fans, BETWEEN)
    for _ in range(2):  # the room for names depends on the scale, which depends on the room
        named = _blocks(fans, max(BETWEEN, LABEL_HEIGHT_PX / _cell_px(named)))
    room_px = (named[:, 2] + BETWEEN) * _cell_px(named)
    fit_above = all(len(name) * CHARACTER_PX < room for name, room in zip(names, room_px, strict=True))
    blocks = named if fit_above else blocks
    cell_px = _cell_px(blocks)
    cells = np.concatenate([_cells(block, count) for block, count in zip(blocks, fans, strict=True)])
    if fit_above:
        labelled = list(range(len(names)))
        labels = np.stack([blocks[:, 0] + blocks[:, 2] / 2, blocks[:, 1] - LABEL_HEIGHT_PX / cell_px], axis=1)
    else:
        labelled = np.flatnonzero(blocks[:, 0] == 0.0).tolist()
        lengths = np.array([len(names[tray]) for tray in labelled])
        left = -(lengths * CHARACTER_PX / 2 + LABEL_HEIGHT_PX / 2) / cell_px
        labels = np.stack([left, blocks[labelled, 1] + blocks[labelled, 3] / 2 - LABEL_HEIGHT_PX / 2 / cell_px], axis=1)
    return FleetMap(cells, blocks, labels, labelled, *_extent(blocks), cell_px)


def _blocks(fans: Sequence[int], gap: float) -> Array:
    """Blocks as square as their numbers of fans allow, in rows `gap` apart, with the largest cells that fit the map."""
    columns = [math.ceil(math.sqrt(count)) for count in fans]
    sizes = [(wide, math.ceil(count / wide)) for wide, count in zip(columns, fans, strict=True)]
    area = sum((wide + BETWEEN) * (high + gap) for wide, high in sizes)
    width = math.sqrt(area * MAP_PX[0] / MAP_PX[1])
    widths = np.cumsum(np.array(columns) + BETWEEN)  # of rows that end after one of the first blocks
    near = widths[(widths > 0.6 * width) & (widths < 1.6 * width)].tolist()
    return max((_in_rows(sizes, gap, each) for each in (width, *near)), key=_cell_px)


def _in_rows(sizes: Sequence[tuple[int, int]], gap: float, row_width: float) -> Array:
    blocks: list[tuple[float, float, float, float]] = []
    left = top = row_height = 0.0
    for wide, high in sizes:
        if left and left + wide > row_width:
            left, top, row_height = 0.0, top + row_height + gap, 0.0
        blocks.append((left, top, wide, high))
        left += wide + BETWEEN
        row_height = max(row_height, high)
    return np.array(blocks, float)


def _extent(blocks: Array) -> tuple[float, float]:
    return float((blocks[:, 0] + blocks[:, 2]).max()), float((blocks[:, 1] + blocks[:, 3]).max())


def _cell_px(blocks: Array) -> float:
    """Size of a cell in a window of full HD."""
    width, height = _extent(blocks)
    return min(MAP_PX[0] / width, MAP_PX[1] / height)


def _cells(block: Array, count: int) -> Array:
    left, top, wide, _ = block
    number = np.arange(count)
    return np.stack([left + number % wide + 0.5, top + number // wide + 0.5], axis=1)
