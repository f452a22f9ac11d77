"""Predicts blocks of several trays with one twin in one pass. Processed alone, each would differ only by rounding."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

from fantwin.pipeline.prediction.joint_states import JointStates
from fantwin.pipeline.prediction.tray_integrator import TrayIntegrator
from fantwin.schemas.messages import Grid, Prediction
from fantwin.schemas.side_by_side import apart, side_by_side

MOST_KEPT = 16
"""joint integrators, each for one number of trays: what they hold is small"""


class JointTrayIntegrator:
    """Predicts the trays of one process together, for any twins."""

    def __init__(self) -> None:
        self._kept: dict[Hashable, TrayIntegrator] = {}
        """joint integrators, by twin, fans of a tray, and number of trays; the one that was used last is the last"""

    def predict(self, integrators: Sequence[TrayIntegrator], grids: Sequence[Grid]) -> list[Prediction]:
        """Predict as TrayIntegrator.predict of each; the keys of their blocks are equal (`joint_key`)."""
        if len(integrators) == 1:
            return [integrators[0].predict(grids[0])]
        joint = self._of_trays(integrators)
        joint.continue_from(integrators[0])
        begin_t_ns = [int(grid.t_ns[0]) for grid in grids]
        states = JointStates(joint.states, [each.states for each in integrators], begin_t_ns)
        states.gather()
        predictions = apart(joint.predict(side_by_side(grids)), [grid.t_ns for grid in grids])
        states.scatter()
        for each, grid in zip(integrators, grids, strict=True):
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
