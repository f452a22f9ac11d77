"""Some columns of a message, read without the others: the same values as by decoding it in full."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fantwin.schemas import fan_pb2
from fantwin.schemas.codec import CodecError, decode, decode_columns, encode
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.fields import columns, other_fields
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Grid, Message, Prediction, Raw, Score
from tests.support.message_strategies import any_message, same
from tests.support.score_data import made_up_tray

MESSAGES: st.SearchStrategy[Message] = st.one_of(any_message(Score), any_message(Prediction), any_message(Raw))


def outcome(kind: type[Message], payload: bytes, names: tuple[str, ...] | None = None) -> dict[str, Any] | str:
    """The fields that are no columns and the named columns; "refused" if it is no such message."""
    try:
        read: Any = decode(kind, payload) if names is None else decode_columns(kind, payload, names)
    except CodecError:
        return "refused"
    return {name: getattr(read, name) for name in other_fields(kind)} | {
        name: getattr(read, name) for name in (columns(kind) if names is None else names)
    }


def equal(some: dict[str, Any] | str, full: dict[str, Any] | str) -> bool:
    if isinstance(some, str) or isinstance(full, str):
        return some == full
    return all(same(value, full[name]) for name, value in some.items())


@given(MESSAGES, st.data())
def test_the_named_columns_and_all_that_is_no_column_are_as_decoded_in_full(message: Message, data: st.DataObject):
    names = tuple(data.draw(st.sets(st.sampled_from(sorted(columns(type(message)))))))
    payload = encode(message)
    assert equal(outcome(type(message), payload, names), outcome(type(message), payload))


def test_columns_that_are_not_named_are_empty_and_nothing_is_copied():
    (score,), _ = made_up_tray(seconds=0.1)
    payload = encode(score)
    read = decode_columns(Score, payload, ("score",))
    assert same(read.score, score.score) and same(read.t_ns, score.t_ns)
    assert np.shares_memory(read.score, np.frombuffer(payload, np.uint8)) and not read.score.flags.writeable
    assert {name for name in columns(Score) if getattr(read, name).size} == {"t_ns", "score"}


def test_a_column_that_another_encoder_wrote_in_pieces_is_read():
    (score,), _ = made_up_tray(seconds=0.1)
    in_pieces = b"".join(encode(part) for part in made_up_tray(seconds=0.1, block=5)[0])
    assert same(decode_columns(Score, in_pieces, ("state",)).state, score.state)


@given(any_message(Grid), st.data())
def test_damaged_bytes_are_read_as_in_full_or_refused(message: Grid, data: st.DataObject):
    """With all columns named; what is not looked at may be damaged."""
    payload = bytearray(encode(message))
    for _ in range(data.draw(st.integers(1, 3))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(payload[: data.draw(st.integers(0, len(payload)))])
    assert equal(outcome(Grid, cut, tuple(columns(Grid))), outcome(Grid, cut))


@pytest.mark.parametrize("fans", [0, 2])
def test_a_column_that_does_not_fit_the_samples_is_refused(fans: int):
    wrong = fan_pb2.Score(fans=fans, period_ns=10, t_ns=[5], score=[0.25, 0.5, 0.75])
    with pytest.raises(CodecError, match="score has"):
        decode_columns(Score, wrong.SerializeToString(), ("score",))


def test_an_envelope_reads_its_header_without_the_rest():
    payload = encode(Raw(header=Header("p", 7, "tray1"), fans=1)) + b"\xff"
    envelope = Envelope("fantwin/s/tray1/raw", "raw", payload, 0)
    assert (envelope.header.producer, envelope.header.sequence, envelope.header.tray) == ("p", 7, "tray1")
    with pytest.raises(CodecError):
        _ = envelope.message
