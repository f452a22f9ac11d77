"""State in arrays with a column for each fan, for joining trays (`pipeline.prediction.joint_tray_integrator`)."""

from __future__ import annotations

from abc import ABC, abstractmethod

from fantwin.schemas.messages import Array

NEVER_NS = -(1 << 62)
"""a time long before all others"""


class ColumnState(ABC):
    """Keeps all its state in arrays."""

    @abstractmethod
    def columns(self) -> dict[str, Array]:
        """The arrays that hold the state, by name.

        The last axis of each is over the fans, if it is of fans. Names of times end in `_t_ns`; NEVER_NS stands for
        none.
        """
