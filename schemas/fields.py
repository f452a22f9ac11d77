"""How the fields of a message are declared: enums that keep unknown values, and columns that describe themselves.

Codec, export and tests derive everything they need from these declarations and from the annotations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from enum import IntEnum
from functools import cache
from typing import Any, Literal, Self, TypeAlias, get_type_hints

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]
Shape: TypeAlias = Literal["samples", "samples x fans", "fans"]

LARGEST_ENUM_VALUE = 127
"""a packed enum value is then one byte, so that a column of enums is its own encoding"""


class OpenEnum(IntEnum):
    """An enum whose unknown values are kept, as protobuf keeps them: a newer producer may send them.

    `FanState(99)` is a member named `UNKNOWN (99)`, equal to 99. Only values outside 0 to 127 raise ValueError.
    """

    @classmethod
    def _missing_(cls, value: object) -> OpenEnum | None:
        if not isinstance(value, int | np.integer) or not 0 <= value <= LARGEST_ENUM_VALUE:
            return None
        unknown = int.__new__(cls, value)
        unknown._name_ = f"UNKNOWN ({value})"
        unknown._value_ = int(value)
        return unknown

    @classmethod
    def known(cls, value: object) -> Self:
        """The member with this value. Raises ValueError for an unknown value, too: for stored state, not messages."""
        member = cls(value)
        if not member.is_known:
            raise ValueError(f"{value!r} is not a known {cls.__name__}")
        return member

    @property
    def is_known(self) -> bool:
        """Whether this version defines the value."""
        return self.name in type(self).__members__

    @property
    def words(self) -> str:
        """The name as people read it: `out of service`, `unknown (99)`."""
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True, slots=True)
class Column:
    """What a message's field says about its array.

    Attributes:
        shape: `samples` (n,), `samples x fans` (n, fans) or `fans` (fans,).
        dtype: of the array, and of its packed bytes.
        enum: what the values mean; None for quantities.
        optional: whether the array may be empty although the message has samples, because a recording lacks it.
        limits: the smallest and the largest value accepted; None for any.
        part: the field of the protobuf message whose nested message has it; empty: the message itself has it.
    """

    shape: Shape
    dtype: np.dtype[Any]
    enum: type[OpenEnum] | None = None
    optional: bool = False
    limits: tuple[int, int] | None = None
    part: str = ""

    @property
    def by_fan(self) -> bool:
        """Whether the array has an axis of fans."""
        return self.shape != "samples"

    @property
    def by_sample(self) -> bool:
        """Whether the array has an axis of samples."""
        return self.shape != "fans"


def column(
    shape: Shape,
    kind: type,
    *,
    optional: bool = False,
    limits: tuple[int, int] | None = None,
) -> Any:
    """Declare a column of a message; see `Column`. `kind` is a NumPy type or an OpenEnum."""
    enum = kind if issubclass(kind, OpenEnum) else None
    dtype = np.dtype(np.uint8 if enum else kind)
    if enum:
        limits = (0, LARGEST_ENUM_VALUE)
    declared = Column(shape, dtype, enum, optional, limits)
    return field(default_factory=lambda: np.zeros(0, dtype), metadata={"column": declared})


class DerivedColumn:
    """A column `samples x fans` that follows from others: it does not travel, and tables have it."""

    def __init__(self, compute: Callable[[Any], Array], kind: type) -> None:
        self.declared = Column("samples x fans", np.dtype(kind))
        self._compute = compute
        self.__doc__ = compute.__doc__

    def __get__(self, message: Any, owner: type) -> Array:
        return self._compute(message)


def derived(kind: type) -> Callable[[Callable[[Any], Array]], DerivedColumn]:
    """Declare a column that a method computes from others; `kind` is a NumPy type."""
    return lambda compute: DerivedColumn(compute, kind)


@cache
def derived_columns(message_type: type) -> dict[str, Column]:
    """The derived columns of a message type by name, in its order."""
    found = {name: value for kind in reversed(message_type.__mro__) for name, value in vars(kind).items()}
    return {name: value.declared for name, value in found.items() if isinstance(value, DerivedColumn)}


@cache
def columns(message_type: type) -> dict[str, Column]:
    """The columns of a message type by name, in its order; those of a nested message come last."""
    declared = {f.name: f.metadata["column"] for f in fields(message_type) if "column" in f.metadata}
    return dict(sorted(declared.items(), key=lambda item: bool(item[1].part)))


@cache
def other_fields(message_type: type) -> dict[str, Any]:
    """The fields of a message or record that are no columns: name -> annotated type, in its order."""
    types = get_type_hints(message_type)
    return {f.name: types[f.name] for f in fields(message_type) if "column" not in f.metadata}


@cache
def time_column(message_type: type) -> str:
    """Name of the field with the time of a message's samples; `t_ns` for a message about one moment."""
    return next((name for name, column in columns(message_type).items() if column.shape == "samples"), "t_ns")
