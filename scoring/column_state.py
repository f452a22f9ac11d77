"""State that consists of arrays, to JSON and back: used by the snapshots of detectors, baselines and filters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np

from schemas.messages import Array

NEVER_NS = -(1 << 62)
"""a time long before all others"""


class ColumnState(ABC):
    """Keeps all its state in arrays, so that a snapshot is the arrays by name."""

    @abstractmethod
    def columns(self) -> dict[str, Array]:
        """The arrays that hold the state, by the name they have in a snapshot. `restore` writes into them.

        The last axis of each is over the fans, if it is of fans. Names of times end in `_t_ns`; NEVER_NS stands for
        none.
        """

    def arrays(self) -> dict[str, Array]:
        """The columns, and what else is kept that follows from them."""
        return self.columns()

    def snapshot(self) -> dict[str, Any]:
        """The state as JSON can hold it, which has no NaN."""
        return {name: _plain(column) for name, column in self.columns().items()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a snapshot.

        Raises:
            ValueError, KeyError, TypeError: it is no snapshot of this state, or one of another number of fans.
        """
        for name, column in self.columns().items():
            restore_column(column, name, state[name])


def restore_column(column: Array, name: str, values: Any) -> None:
    """Write the values of a snapshot into an array.

    Raises:
        ValueError, TypeError: they are of another shape, or no numbers.
    """
    restored = np.array(values, column.dtype)
    if restored.shape != column.shape:
        raise ValueError(f"{name} has the shape {restored.shape}, not {column.shape}")
    column[...] = restored


def _plain(column: Array) -> Any:
    if column.dtype.kind != "f":
        return column.tolist()
    values = column.astype(object)
    values[np.isnan(column)] = None
    return values.tolist()
