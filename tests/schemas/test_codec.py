"""The codec: inverse of itself, and standard protobuf to everybody else."""

import contextlib
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor import FieldDescriptor
from hypothesis import assume, given
from hypothesis import strategies as st
from mcap.records import Schema
from mcap.well_known import MessageEncoding
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import build_file_descriptor_set

from schemas import fan_pb2, messages
from schemas.codec import CodecError, decode, encode, proto_type, type_name
from schemas.messages import (
    MESSAGE_TYPES,
    Command,
    Counter,
    Grid,
    Header,
    Input,
    Message,
    Output,
    Prediction,
    Raw,
    Score,
    columns,
)
from tests.support.message_strategies import any_message, same

MESSAGES = st.sampled_from(MESSAGE_TYPES).flatmap(any_message)


def everybody_elses_decoder(message_type: type[Message]) -> Any:
    """What a reader of recordings uses that knows only the schema in the file."""
    schema = Schema(
        id=1,
        name=type_name(message_type),
        encoding="protobuf",
        data=build_file_descriptor_set(proto_type(message_type)).SerializeToString(),
    )
    decoder = DecoderFactory().decoder_for(MessageEncoding.Protobuf, schema)
    assert decoder is not None
    return decoder


@given(MESSAGES)
def test_decoding_gives_back_what_was_encoded(message):
    back = decode(type(message), encode(message))
    for f in fields(message):
        assert same(getattr(message, f.name), getattr(back, f.name)), f.name


@given(MESSAGES)
def test_what_is_encoded_is_read_without_our_code(message):
    proto = everybody_elses_decoder(type(message))(encode(message))
    assert proto.header.producer == message.header.producer
    assert proto.header.sequence == message.header.sequence
    assert proto.header.tray == message.header.tray
    own_columns = columns(type(message))
    for f in fields(message):
        ours, theirs = getattr(message, f.name), getattr(proto, f.name)
        if f.name in own_columns:
            assert same(ours.ravel(), np.asarray(list(theirs), dtype=own_columns[f.name][1])), f.name
        elif f.name in ("inputs", "outputs", "counters"):
            assert [[getattr(o, g.name) for g in fields(o)] for o in ours] == [
                [getattr(t, g.name) for g in fields(o)] for o, t in zip(ours, theirs, strict=True)
            ]
        elif f.name != "header":
            assert same(ours, type(ours)(theirs)), f.name


@given(MESSAGES)
def test_what_protobuf_itself_writes_is_decoded(message):
    proto = proto_type(type(message)).FromString(encode(message))
    back = decode(type(message), proto.SerializeToString())
    assert all(same(getattr(message, f.name), getattr(back, f.name)) for f in fields(message))


@given(MESSAGES, st.data())
def test_torn_bytes_are_refused_or_are_another_message_but_never_crash(message, data):
    payload = encode(message)
    torn = payload[: data.draw(st.integers(0, len(payload)))]
    with contextlib.suppress(CodecError):
        decode(type(message), torn)


@given(st.sampled_from(MESSAGE_TYPES), st.binary(max_size=200))
def test_any_bytes_are_refused_or_decoded_but_never_crash(message_type, payload):
    with contextlib.suppress(CodecError):
        decode(message_type, payload)


@pytest.mark.parametrize("message_type", MESSAGE_TYPES, ids=lambda t: t.__name__)
def test_a_message_has_the_fields_of_its_schema_in_their_order(message_type):
    assert [f.name for f in fields(message_type)] == [f.name for f in proto_type(message_type).DESCRIPTOR.fields]


@pytest.mark.parametrize("record", [Header, Counter, Input, Output], ids=lambda t: t.__name__)
def test_a_record_has_the_fields_of_its_schema_in_their_order(record):
    assert [f.name for f in fields(record)] == [f.name for f in getattr(fan_pb2, record.__name__).DESCRIPTOR.fields]


@pytest.mark.parametrize("message_type", MESSAGE_TYPES, ids=lambda t: t.__name__)
def test_a_column_is_what_its_schema_says(message_type):
    wire_types = {
        FieldDescriptor.TYPE_DOUBLE: np.dtype(np.float64),
        FieldDescriptor.TYPE_SFIXED64: np.dtype(np.int64),
        FieldDescriptor.TYPE_FIXED32: np.dtype(np.uint32),
        FieldDescriptor.TYPE_BOOL: np.dtype(np.bool_),
        FieldDescriptor.TYPE_ENUM: np.dtype(np.uint8),
    }
    repeated = {
        f.name: wire_types[f.type]
        for f in proto_type(message_type).DESCRIPTOR.fields
        if f.is_repeated and f.type in wire_types
    }
    assert {name: dtype for name, (_, dtype) in columns(message_type).items()} == repeated


@pytest.mark.parametrize("name", ["InvalidReason", "FanState", "Severity", "StageStatus"])
def test_an_enum_has_the_values_of_its_schema(name):
    ours, theirs = getattr(messages, name), getattr(fan_pb2, name)
    prefix = {
        "InvalidReason": "INVALID_REASON_",
        "FanState": "FAN_STATE_",
        "Severity": "SEVERITY_",
        "StageStatus": "STAGE_STATUS_",
    }
    assert {prefix[name] + value.name: value.value for value in ours} == dict(theirs.items())


def test_columns_that_do_not_fit_the_message_are_refused():
    with pytest.raises(CodecError, match=r"Raw\.command has shape \(2,\)"):
        encode(Raw(fans=1, host_receive_t_ns=np.arange(2), command=np.zeros(2), speed_rad_s=np.zeros((2, 1))))
    with pytest.raises(CodecError, match=r"Command\.command has shape \(3,\)"):
        encode(Command(fans=2, t_ns=0, command=np.zeros(3), set_point_rad_s=np.zeros(2)))


def test_bytes_whose_columns_disagree_are_refused():
    proto = fan_pb2.Grid(fans=2, period_ns=1, t_ns=[1, 2], command=[1.0, 2.0])
    with pytest.raises(CodecError, match="shape"):
        decode(Grid, proto.SerializeToString())


def test_decoded_columns_cannot_be_changed_by_mistake():
    back = decode(Command, encode(Command(fans=1, t_ns=0, command=np.ones(1), set_point_rad_s=np.ones(1))))
    assert isinstance(back, Command)
    with pytest.raises(ValueError, match="read-only"):
        back.command[0] = 2.0


def test_a_value_that_no_enum_knows_is_refused_and_not_wrapped():
    state_300 = bytes((14 << 3 | 2, 2, 0xAC, 0x02))  # field 14, two bytes: the varint 300
    with pytest.raises(CodecError, match="Score.state holds values that are not known here"):
        decode(Score, state_300)


def test_a_message_that_lacks_a_column_of_its_samples_is_refused():
    proto = fan_pb2.Grid(fans=1, period_ns=1, t_ns=[1])
    with pytest.raises(CodecError, match=r"Grid.command has shape \(0, 1\), not samples x fans = \(1, 1\)"):
        decode(Grid, proto.SerializeToString())


def grid_with(period_ns: int, t_ns: int) -> Grid:
    one = np.zeros((1, 1))
    return Grid(
        fans=1,
        period_ns=period_ns,
        t_ns=np.array([t_ns]),
        command=one,
        speed_rad_s=one,
        valid=one > 0,
        invalid_reason=one,
    )


LENGTHS = pytest.mark.parametrize("samples", [1, 47, 48, 49, 600])
"""short and long blocks are decoded on different ways"""


def grid_of(samples: int) -> Grid:
    rng = np.random.default_rng(samples)
    speed = rng.normal(size=(samples, 2))
    speed[rng.random(speed.shape) < 0.1] = np.nan
    invalid_reason = rng.integers(0, 8, speed.shape).astype(np.uint8)
    t_ns = np.arange(samples) + 10**18
    return Grid(
        fans=2,
        period_ns=1,
        t_ns=t_ns,
        command=-speed,
        speed_rad_s=speed,
        valid=invalid_reason == 0,
        invalid_reason=invalid_reason,
    )


def older(message: Message, *lacks: str) -> bytes:
    """As it was recorded before these columns were added."""
    proto = proto_type(type(message)).FromString(encode(message))
    for name in lacks:
        proto.ClearField(name)
    return proto.SerializeToString()


BEFORE_BALANCE = {
    Prediction: ("torque_balance_command", "torque_balance_sigma_command"),
    Score: ("torque_balance_command", "speed_baseline_rad_s", "balance_baseline_command", "score", "statistic"),
}


@pytest.mark.parametrize("kind", BEFORE_BALANCE)
@given(data=st.data())
def test_what_was_recorded_before_a_column_was_added_reads_as_not_known(kind, data):
    message: Any = data.draw(any_message(kind))
    assume(len(message.t_ns) > 0)
    back: Any = decode(kind, older(message, *BEFORE_BALANCE[kind]))
    for name, (shape, dtype) in columns(kind).items():
        values, there = getattr(back, name), getattr(message, name)
        if name not in BEFORE_BALANCE[kind]:
            assert same(there, values), name
            continue
        assert (values.shape, values.dtype) == (there.shape, dtype), shape
        assert np.isnan(values).all() if dtype.kind == "f" else (values == 0).all()
    again = decode(kind, encode(back))
    assert all(same(getattr(back, name), getattr(again, name)) for name in columns(kind))


def test_a_column_that_was_always_there_is_still_asked_for_and_nobody_is_believed_about_fans():
    score = fan_pb2.Score(period_ns=1, fans=1 << 31, t_ns=[0])
    with pytest.raises(CodecError, match="command has shape"):
        decode(Score, score.SerializeToString())


@LENGTHS
def test_blocks_of_any_length_come_back(samples):
    message = grid_of(samples)
    back = decode(Grid, encode(message))
    assert all(same(getattr(message, name), getattr(back, name)) for name in columns(Grid))


@LENGTHS
@pytest.mark.parametrize(
    ("column", "value"), [("invalid_reason", 8), ("invalid_reason", -1), ("t_ns", 2**62), ("t_ns", -(2**62))]
)
def test_a_value_out_of_its_limits_is_refused_in_blocks_of_any_length(samples, column, value):
    proto = fan_pb2.Grid.FromString(encode(grid_of(samples)))
    getattr(proto, column)[samples // 2] = value
    with pytest.raises(CodecError, match=rf"Grid\.{column}"):
        decode(Grid, proto.SerializeToString())


@pytest.mark.parametrize("period_ns", [0, -1, 2**62])
@pytest.mark.parametrize("kind", [Grid, Prediction, Score])
def test_a_step_that_is_none_is_refused_on_both_ways(kind, period_ns):
    with pytest.raises(CodecError, match="period_ns"):
        encode(kind(fans=1, period_ns=period_ns))
    with pytest.raises(CodecError, match="period_ns"):
        decode(kind, proto_type(kind)(fans=1, period_ns=period_ns).SerializeToString())


@pytest.mark.parametrize("t_ns", [2**62, -(2**62)])
def test_a_time_beyond_2116_is_refused_on_both_ways(t_ns):
    with pytest.raises(CodecError, match="2116"):
        encode(grid_with(1, t_ns))
    proto = fan_pb2.Grid.FromString(encode(grid_with(1, t_ns // 2)))
    proto.t_ns[0] = t_ns
    with pytest.raises(CodecError, match="2116"):
        decode(Grid, proto.SerializeToString())


def test_a_prediction_with_samples_but_no_sigma_is_refused_on_both_ways():
    one = np.zeros((1, 1))
    names = (
        "command",
        "measured_speed_rad_s",
        "predicted_speed_rad_s",
        "valid",
        "invalid_reason",
        "torque_balance_command",
    )
    sigmas = {"sigma_rad_s": np.ones(1), "torque_balance_sigma_command": np.ones(1)}
    good = Prediction(fans=1, period_ns=1, t_ns=np.array([5]), **sigmas, **dict.fromkeys(names, one))
    with pytest.raises(CodecError, match="sigma_rad_s"):
        encode(replace(good, sigma_rad_s=np.zeros(0)))
    proto = proto_type(Prediction).FromString(encode(good))
    proto.ClearField("sigma_rad_s")
    with pytest.raises(CodecError, match="sigma_rad_s"):
        decode(Prediction, proto.SerializeToString())
