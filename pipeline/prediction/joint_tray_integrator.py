"""Predicts blocks of several trays with one twin in one pass. Processed alone, each would differ only by rounding.

The states of the trays are put together as those of one tray that has the fans of all, and taken apart again.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np

from fantwin.pipeline.prediction.tray_integrator import TrayIntegrator
from fantwin.schemas.blocks import apart, side_by_side
from fantwin.schemas.messages import Array, Grid, Prediction
from fantwin.scoring.column_state import NEVER_NS, ColumnState


class JointStates:
    """States of trays with the same number of fans, whose present blocks are processed in one pass.

    The times of a tray whose block begins later than the first one are moved back by as much.
    """

    def __init__(
        self, joint: Sequence[ColumnState], of_trays: Sequence[Sequence[ColumnState]], begin_t_ns: Sequence[int]
    ) -> None:
        """joint: with the fans of all trays. of_trays: of each, the same states in the same order. begin_t_ns: when the
        block of each begins."""
        self._joint = joint
        self._arrays = [[state.columns() for state in states] for states in zip(*of_trays, strict=True)]
        self._trays = len(of_trays)
        self._later_ns = np.array(begin_t_ns) - begin_t_ns[0]

    def gather(self) -> None:
        """Write the states of the trays into the joint ones."""
        for state, of_trays in zip(self._joint, self._arrays, strict=True):
            for name, array in state.columns().items():
                np.concatenate([of_tray[name] for of_tray in of_trays], axis=-1, out=array)
                self._move(name, array, -1)

    def scatter(self) -> None:
        """Write the joint states back to those of the trays."""
        for state, of_trays in zip(self._joint, self._arrays, strict=True):
            for name, array in state.columns().items():
                self._move(name, array, 1)
                fans = array.shape[-1] // self._trays
                for k, of_tray in enumerate(of_trays):
                    of_tray[name][...] = array[..., k * fans : (k + 1) * fans]

    def _move(self, name: str, array: Array, times: int) -> None:
        if name.endswith("_t_ns") and self._later_ns.any():
            by_ns = times * np.repeat(self._later_ns, array.shape[-1] // self._trays)
            np.copyto(array, array + by_ns, where=array != NEVER_NS)


MOST_KEPT = 16
"""joint integrators, each for one number of trays: what they hold is small"""


class JointTrayIntegrator:
    """Predicts the trays of one process together, for any twins."""

    def __init__(self) -> None:
        self._kept: dict[Hashable, TrayIntegrator] = {}
        """joint integrators, by twin, fans of a tray, and number of trays; the one that was used last is the last"""

    def process(self, cores: Sequence[Any], blocks: Sequence[Grid]) -> list[Prediction]:
        """Predict as TrayIntegrator.predict of each; the keys of their blocks are equal (`joint_key`). cores: each with
        its TrayIntegrator, `tray`."""
        integrators: list[TrayIntegrator] = [core.tray for core in cores]
        if len(integrators) == 1:
            return [integrators[0].predict(blocks[0])]
        joint = self._of_trays(integrators)
        joint.continue_from(integrators[0])
        begin_t_ns = [int(grid.t_ns[0]) for grid in blocks]
        states = JointStates(joint.states, [each.states for each in integrators], begin_t_ns)
        states.gather()
        predictions = apart(joint.predict(side_by_side(blocks)), [grid.t_ns for grid in blocks])
        states.scatter()
        for each, grid in zip(integrators, blocks, strict=True):
            each.skip(grid)
        return predictions

    def _of_trays(self, integrators: Sequence[TrayIntegrator]) -> TrayIntegrator:
        first, count = integrators[0], len(integrators)
        key = (first.twin.sha256, first.twin.fans, count)
        found = self._kept.pop(key, None) or TrayIntegrator(first.twin.of_trays(count), first.config)
        self._kept[key] = found
        if len(self._kept) > MOST_KEPT:
            del self._kept[next(iter(self._kept))]
        return found
