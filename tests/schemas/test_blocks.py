"""schemas.blocks: messages joined and cut are the same samples."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fantwin.schemas.blocks import can_join, cut, join
from fantwin.schemas.fields import columns
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Command, Grid, Message, Prediction, Raw, Score
from tests.support.made_messages import filled
from tests.support.message_strategies import any_message, same

OF_SAMPLES = (Raw, Grid, Prediction, Score)
MESSAGES = st.sampled_from(OF_SAMPLES).flatmap(any_message)


def equal(one: Message, other: Message) -> bool:
    return all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))


def times(message: Any) -> Any:
    return message.host_receive_t_ns if isinstance(message, Raw) else message.t_ns


def grid(samples: int, fans: int = 2, period_ns: int = 10) -> Grid:
    values = np.arange(float(samples * fans)).reshape(samples, fans)
    columns = {"command": values, "speed_rad_s": -values, "valid": values > 1}
    return filled(Grid, samples, fans, period_ns=period_ns, t_ns=np.arange(samples) * period_ns, **columns)


def raw(**present: Any) -> Raw:
    return filled(Raw, 1, 1, **present)


@given(MESSAGES, st.lists(st.integers(0, 5), max_size=3))
def test_a_cut_message_is_joined_to_the_same_message(message: Any, marks: list[int]) -> None:
    ends = sorted({0, len(times(message)), *(min(mark, len(times(message))) for mark in marks)})
    parts = [cut(message, first, end) for first, end in pairwise(ends)] or [message]
    assert equal(join(parts), message)


def test_samples_are_joined_in_the_order_given_under_the_first_header() -> None:
    first, second = replace(grid(2), header=Header("p", 7, "t")), replace(grid(3), header=Header("p", 8, "t"))
    joined = join([second, first])
    assert joined.header.sequence == 8
    assert joined.t_ns.tolist() == [0, 10, 20, 0, 10]
    assert {name: getattr(joined, name).dtype for name in columns(Grid)} == {
        name: getattr(first, name).dtype for name in columns(Grid)
    }


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (grid(1), raw()),
        (grid(1, fans=2), grid(1, fans=3)),
        (grid(1, period_ns=10), grid(1, period_ns=11)),
        (raw(device_clock_us=0), raw()),
        (raw(), raw(device_sequence=0)),
        (Prediction(fans=1, period_ns=1, twin="a"), Prediction(fans=1, period_ns=1, twin="b")),
        (Prediction(fans=1, period_ns=1, sigma_rad_s=np.ones(1)), Prediction(fans=1, period_ns=1)),
        (Command(fans=1, t_ns=0), Command(fans=1, t_ns=0)),
    ],
)
def test_messages_that_differ_in_more_than_their_samples_are_not_joined(one: Any, other: Any) -> None:
    assert not can_join(one, other)
    with pytest.raises(ValueError, match="message 1"):
        join([one, other])
