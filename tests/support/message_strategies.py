"""Hypothesis strategies: any message of any type, whose columns agree on their samples and fans."""

import math
from typing import Any

import numpy as np
from hypothesis import strategies as st

from fantwin.schemas.fields import LARGEST_ENUM_VALUE, Column, OpenEnum, columns, other_fields
from fantwin.schemas.header import Header, InputPosition
from fantwin.schemas.health import (
    AcceptedSamples,
    AwaitedInput,
    Counter,
    FanLearning,
    Input,
    LatencyBucket,
    Learning,
    NamedFan,
    Note,
    Output,
    Sweep,
)
from fantwin.schemas.messages import FURTHEST_T_NS, LARGEST_PERIOD_NS, Diagnosis, Message, StatedTacho

TIME_NS = st.integers(1 - FURTHEST_T_NS, FURTHEST_T_NS - 1)
PERIOD_NS = st.integers(1, LARGEST_PERIOD_NS)
INT64 = st.integers(-(2**63), 2**63 - 1)
UINT64 = st.integers(0, 2**64 - 1)
UINT32 = st.integers(0, 2**32 - 1)
TEXT = st.text(max_size=20)
FLOAT = st.floats(width=64)
POSITION = st.builds(InputPosition, TEXT, TEXT, UINT64, UINT64, UINT64, st.booleans())
HEADER = st.builds(Header, TEXT, UINT64, TEXT, st.none() | POSITION)
_TIMES = (
    "t_ns",
    "onset_t_ns",
    "marked_onset_t_ns",
    "shelved_until_t_ns",
    "since_t_ns",
    "newest_input_t_ns",
    "newest_output_t_ns",
    "first_sample_t_ns",
    "first_t_ns",
    "newest_t_ns",
)
SCALARS: dict[str, st.SearchStrategy[Any]] = {
    **dict.fromkeys(_TIMES, INT64),
    "period_ns": PERIOD_NS,
    "process_id": UINT32,
    "format": UINT32,
    "fans": UINT32,
    "until_t_ns": TIME_NS,
    "pulses": UINT32,
    "lost": UINT64,
    "fan": st.integers(0, 2**31 - 1),
}
OF_TYPE: dict[Any, st.SearchStrategy[Any]] = {
    str: TEXT,
    float: FLOAT,
    bool: st.booleans(),
    int: UINT64,
    bytes: st.binary(max_size=20),
}

RECORDS = (
    *(Counter, Input, Output, Diagnosis, AwaitedInput, Note, AcceptedSamples, StatedTacho, LatencyBucket),
    *(FanLearning, Learning, NamedFan),
)
"""of which a message holds several"""


def scalar(name: str, hint: Any) -> st.SearchStrategy[Any]:
    if hint is Header:
        return HEADER
    for record in RECORDS:
        if hint == tuple[record, ...]:
            values = {name: scalar(name, hint) for name, hint in other_fields(record).items()}
            return st.lists(st.builds(record, **values), max_size=3).map(tuple)
    if hint == Sweep | None:
        values = {name: scalar(name, hint) for name, hint in other_fields(Sweep).items()}
        return st.none() | st.builds(Sweep, **values)
    if name in SCALARS:
        return SCALARS[name]
    if isinstance(hint, type) and issubclass(hint, OpenEnum):
        return st.integers(0, LARGEST_ENUM_VALUE).map(hint)
    return OF_TYPE[hint]


SPECIAL = (0.0, -0.0, np.nan, np.inf, -np.inf)


@st.composite
def values_of(draw: st.DrawFn, column: Column, shape: tuple[int, ...]) -> Any:
    """An array of any bits that a column may hold, drawn at once; its first float may be a special one."""
    dtype, size = np.dtype(column.dtype), math.prod(shape)
    drawn = np.frombuffer(draw(st.binary(min_size=8 * size, max_size=8 * size)), np.uint64)
    if column.enum:
        values = (drawn % (LARGEST_ENUM_VALUE + 1)).astype(dtype)
    elif column.limits is not None:
        values = drawn.astype(np.int64) % (2 * FURTHEST_T_NS - 1) + (1 - FURTHEST_T_NS)
    elif dtype.kind == "f":
        values = np.resize(drawn.view(dtype), size)
        values[np.isnan(values)] = np.nan  # others are not the same after a conversion
        values[:1] = draw(st.sampled_from((*SPECIAL, *values[:1].tolist())))
    else:
        values = (drawn % 2 if dtype.kind == "b" else drawn).astype(dtype)
    return values.reshape(shape)


@st.composite
def any_message(
    draw: st.DrawFn, message_type: type[Message], fans: st.SearchStrategy[int] = st.integers(1, 4)
) -> Message:
    samples, own_fans = draw(st.integers(0, 5)), draw(fans)
    shapes = {"samples": (samples,), "samples x fans": (samples, own_fans), "fans": (own_fans,)}
    values: dict[str, Any] = {
        name: draw(values_of(column, shapes[column.shape]))
        for name, column in columns(message_type).items()
        if not (column.optional and draw(st.booleans()))
    }
    for name, hint in other_fields(message_type).items():
        values[name] = own_fans if name == "fans" else draw(scalar(name, hint))
    return message_type(**values)


def same(one: Any, other: Any) -> bool:
    """Equal to the bit, NaN included."""
    if isinstance(one, np.ndarray):
        same_shape = one.shape == other.shape or one.size == other.size == 0
        return one.dtype == other.dtype and same_shape and one.tobytes() == other.tobytes()
    if isinstance(one, float):
        return np.float64(one).tobytes() == np.float64(other).tobytes() or (np.isnan(one) and np.isnan(other))
    return type(one) is type(other) and repr(one) == repr(other)  # which shows NaN in records, too
