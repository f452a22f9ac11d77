"""Hypothesis strategies: any message of any type, whose columns agree on their samples and fans."""

from dataclasses import fields
from enum import IntEnum
from typing import Any, get_type_hints

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from schemas import messages
from schemas.codec import FURTHEST_T_NS, LARGEST_PERIOD_NS
from schemas.messages import (
    Counter,
    Diagnosis,
    FanState,
    Header,
    Input,
    InputPosition,
    InvalidReason,
    Message,
    Output,
    Statistic,
    columns,
)

TIME_NS = st.integers(1 - FURTHEST_T_NS, FURTHEST_T_NS - 1)
STEP_NS = st.integers(1, LARGEST_PERIOD_NS)
INT64 = st.integers(-(2**63), 2**63 - 1)
UINT64 = st.integers(0, 2**64 - 1)
UINT32 = st.integers(0, 2**32 - 1)
TEXT = st.text(max_size=20)
FLOAT = st.floats(width=64)
CAUSE = st.builds(InputPosition, TEXT, TEXT, UINT64, UINT64, UINT64, st.booleans())
HEADER = st.builds(Header, TEXT, UINT64, TEXT, st.none() | CAUSE)
ENUM_COLUMNS = {"invalid_reason": InvalidReason, "state": FanState, "statistic": Statistic}
SCALARS: dict[str, st.SearchStrategy[Any]] = {
    **dict.fromkeys(("t_ns", "onset_t_ns", "shelved_until_t_ns"), INT64),
    "period_ns": STEP_NS,
    "process_id": UINT32,
    "lost": UINT64,
    "fan": st.integers(0, 2**31 - 1),
}
OF_TYPE: dict[Any, st.SearchStrategy[Any]] = {str: TEXT, float: FLOAT, bool: st.booleans(), int: UINT64}


def scalar(name: str, hint: Any) -> st.SearchStrategy[Any]:
    if name in SCALARS:
        return SCALARS[name]
    if isinstance(hint, type) and issubclass(hint, IntEnum):
        return st.sampled_from(hint)
    for record in (Counter, Input, Output, Diagnosis):
        if hint == tuple[record, ...]:
            types = get_type_hints(record)
            values = {f.name: OF_TYPE[types[f.name]] for f in fields(record)}
            return st.lists(st.builds(record, **values), max_size=3).map(tuple)
    return OF_TYPE[hint]


def column(name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> st.SearchStrategy[Any]:
    elements = st.sampled_from([int(value) for value in ENUM_COLUMNS[name]]) if name in ENUM_COLUMNS else None
    if name in ("t_ns", "host_receive_t_ns"):
        elements = TIME_NS
    return st_numpy.arrays(dtype, shape, elements=elements)


@st.composite
def any_message(
    draw: st.DrawFn, message_type: type[Message], fans: st.SearchStrategy[int] = st.integers(1, 4)
) -> Message:
    samples, own_fans = draw(st.integers(0, 5)), draw(fans)
    shapes = {"samples": (samples,), "samples x fans": (samples, own_fans), "fans": (own_fans,)}
    own_columns = columns(message_type)
    hints = get_type_hints(message_type, dict(vars(messages)))
    values: dict[str, Any] = {"header": draw(HEADER)}
    for f in fields(message_type):
        if f.name in own_columns:
            shape, dtype = own_columns[f.name]
            values[f.name] = draw(column(f.name, dtype, shapes[shape]))
        elif f.name == "fans":
            values["fans"] = own_fans
        elif f.name != "header":
            values[f.name] = draw(scalar(f.name, hints[f.name]))
    return message_type(**values)


def same(one: Any, other: Any) -> bool:
    """Equal to the bit, NaN included."""
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    if isinstance(one, float):
        return np.float64(one).tobytes() == np.float64(other).tobytes() or (np.isnan(one) and np.isnan(other))
    return type(one) is type(other) and one == other
