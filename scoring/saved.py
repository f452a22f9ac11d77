"""State: what an object continues from after a restart.

Large states are arrays by name, kept to the bit; small ones are dataclasses, whose columns are lists in JSON. The name
of an array is the path of attributes to it. So a change of `KEPT`, or of the shape of what it names, is another format
of snapshots (schemas.formats).
"""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, TypeAlias

import numpy as np
from pydantic import PlainSerializer, PlainValidator, TypeAdapter

from fantwin.schemas.messages import Array

Kept = dict[str, Any]


class Saved:
    """Object whose state is what `KEPT` names: numbers, arrays, dicts of arrays, and parts that are Saved.

    A part that is None is left out.
    """

    KEPT: ClassVar[tuple[str, ...]]

    def arrays(self) -> dict[str, Array]:
        """The state."""
        found: dict[str, Array] = {}
        for name in self.KEPT:
            value = getattr(self, name)
            if isinstance(value, Saved | dict):
                inner = value.arrays() if isinstance(value, Saved) else value
                found |= {f"{name}.{each}": array for each, array in inner.items()}
            elif value is not None:
                found[name] = np.asarray(value)
        return found

    def restore(self, stored: Mapping[str, Array]) -> None:
        """Continue from the state of another. A part of it may have been taken if this raises.

        Raises:
            KeyError, ValueError: an array is missing, has another shape or type, or is not finite where the present one
                is.
        """
        for name in self.KEPT:
            self.restore_one(name, stored)

    def restore_one(self, name: str, stored: Mapping[str, Array]) -> None:
        """Continue from one entry of `KEPT`. Raises: as `restore`."""
        value = getattr(self, name)
        if isinstance(value, Saved):
            value.restore(part(name, stored))
        elif isinstance(value, dict):
            setattr(self, name, {key: alike(each, stored, f"{name}.{key}") for key, each in value.items()})
        elif value is not None:
            found = alike(value, stored, name)
            setattr(self, name, int(found) if isinstance(value, int) else found)


def alike(value: Any, stored: Mapping[str, Array], name: str) -> Array:
    """Take an array in the place of a value. Raises: as `Saved.restore`."""
    now, found = np.asarray(value), stored[name]
    if found.shape != now.shape or found.dtype != now.dtype:
        raise ValueError(f"{name} is {found.dtype} {found.shape}, not {now.dtype} {now.shape}")
    if np.isfinite(now).all() and not np.isfinite(found).all():
        raise ValueError(f"{name} is not finite")
    return found.copy()


def part(name: str, stored: Mapping[str, Array]) -> dict[str, Array]:
    """Select the arrays of a part."""
    return {each.removeprefix(f"{name}."): array for each, array in stored.items() if each.startswith(f"{name}.")}


def as_json(arrays: Mapping[str, Array]) -> Kept:
    """The arrays as JSON values, those of a part within an object: type, shape and bytes in base64 of each."""
    found: Kept = {}
    for name, array in arrays.items():
        *parts, own = name.split(".")
        place = found
        for each in parts:
            place = place.setdefault(each, {})
        place[own] = (array.dtype.str, list(array.shape), base64.b64encode(array.tobytes()).decode("ascii"))
    return found


def from_json(kept: Kept, of_part: str = "") -> dict[str, Array]:
    """The arrays of `as_json`.

    Raises:
        ValueError, TypeError, AttributeError: it is not that.
    """
    found: dict[str, Array] = {}
    for own, value in kept.items():
        name = f"{of_part}{own}"
        if isinstance(value, dict):
            found |= from_json(value, f"{name}.")
            continue
        dtype, shape, data = value
        if not re.fullmatch("[<>|][biuf][1248]", dtype):
            raise ValueError(f"{name} holds no numbers")
        found[name] = np.frombuffer(base64.b64decode(data, validate=True), dtype).reshape(shape)
    return found


def _times(values: object) -> Array:
    return np.array(TypeAdapter(list[int]).validate_python(values), np.int64)


def _flags(values: object) -> Array:
    return np.array(TypeAdapter(list[bool]).validate_python(values), np.bool_)


Times: TypeAlias = Annotated[Array, PlainValidator(_times), PlainSerializer(np.ndarray.tolist)]
Flags: TypeAlias = Annotated[Array, PlainValidator(_flags), PlainSerializer(np.ndarray.tolist)]
Arrays: TypeAlias = Annotated[dict[str, Array], PlainValidator(from_json), PlainSerializer(as_json)]
