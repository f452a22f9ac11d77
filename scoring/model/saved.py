"""Arrays of a state as JSON values and back, to the bit: what a snapshot keeps of them."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from fantwin.schemas.messages import Array

Kept = Mapping[str, tuple[str, list[int], str]]
"""type, shape and bytes in base64, of each array by name"""


def as_json(arrays: Mapping[str, Array]) -> Kept:
    """The arrays as JSON values."""
    return {
        name: (array.dtype.str, list(array.shape), base64.b64encode(array.tobytes()).decode("ascii"))
        for name, array in arrays.items()
    }


def from_json(kept: Kept) -> dict[str, Array]:
    """The arrays of `as_json`.

    Raises:
        ValueError, TypeError, AttributeError: it is not that.
    """
    found: dict[str, Array] = {}
    for name, (dtype, shape, data) in kept.items():
        if np.dtype(dtype).hasobject:
            raise ValueError(f"{name} holds no numbers")
        found[name] = np.frombuffer(base64.b64decode(data, validate=True), dtype).reshape(shape).copy()
    return found


class Saved:
    """State that consists of the arrays that `KEPT` names."""

    KEPT: ClassVar[tuple[str, ...]]

    def arrays(self) -> dict[str, Array]:
        """The state, by name."""
        return {name: getattr(self, name) for name in self.KEPT}

    def restore(self, stored: Mapping[str, Array]) -> None:
        """Continue from the arrays of another; nothing has changed if this raises.

        Raises:
            ValueError, KeyError: one is missing, or is of another number of fans.
        """
        for name, column in self.arrays().items():
            if stored[name].shape != column.shape or stored[name].dtype.kind != column.dtype.kind:
                raise ValueError(f"{name} has the shape {stored[name].shape}, not {column.shape}")
        for name in self.KEPT:
            setattr(self, name, stored[name].copy())


def within(name: str, arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Arrays under the name of what they are the state of."""
    return {f"{name}.{each}": array for each, array in arrays.items()}


def part(name: str, stored: Mapping[str, Array]) -> dict[str, Array]:
    """Select the columns that `within` has put under a name."""
    return {each.removeprefix(f"{name}."): array for each, array in stored.items() if each.startswith(f"{name}.")}
