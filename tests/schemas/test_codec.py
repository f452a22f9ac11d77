"""The codec: decoding inverts encoding, and the bytes are standard protobuf."""

import contextlib
import pickle
import re
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor import FieldDescriptor
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Schema
from mcap.well_known import MessageEncoding
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import build_file_descriptor_set

from fantwin.schemas import fan_pb2, messages
from fantwin.schemas.channels import BY_NAME
from fantwin.schemas.codec import CodecError, decode, encode, proto_type, type_name
from fantwin.schemas.fields import OpenEnum, columns, other_fields, time_column
from fantwin.schemas.header import Header, InputPosition
from fantwin.schemas.health import Counter, Input, Output
from fantwin.schemas.messages import Command, Diagnosis, Grid, Message, Prediction, Raw, Score
from tests.support.made_messages import MESSAGE_TYPES, filled
from tests.support.message_strategies import any_message, same

ENUMS: list[type[OpenEnum]] = OpenEnum.__subclasses__()
RECORDS = [Header, InputPosition, Diagnosis, Counter, Input, Output]
WIRE_TYPES = {
    FieldDescriptor.TYPE_DOUBLE: np.dtype(np.float64),
    FieldDescriptor.TYPE_FLOAT: np.dtype(np.float32),
    FieldDescriptor.TYPE_SFIXED64: np.dtype(np.int64),
    FieldDescriptor.TYPE_FIXED32: np.dtype(np.uint32),
    FieldDescriptor.TYPE_BOOL: np.dtype(np.bool_),
    FieldDescriptor.TYPE_ENUM: np.dtype(np.uint8),
}
MESSAGES = st.sampled_from(MESSAGE_TYPES).flatmap(any_message)


LENGTHS = pytest.mark.parametrize("samples", [1, 48, 49])
"""short and long blocks are decoded by different code"""


def third_party_decoder(message_type: type[Message]) -> Any:
    """The decoder of a reader that knows only the schema in a recording."""
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
def test_decoding_inverts_encoding(message):
    back = decode(type(message), encode(message))
    for f in fields(message):
        assert same(getattr(message, f.name), getattr(back, f.name)), f.name


def agree(ours: Any, theirs: Any) -> bool:
    """Whether a third party reads the same, also in records."""
    if not isinstance(ours, tuple):
        return same(ours, type(ours)(theirs))
    pairs = zip(ours, theirs, strict=True)
    return all(agree(getattr(our, f.name), getattr(their, f.name)) for our, their in pairs for f in fields(our))


@given(MESSAGES)
def test_a_third_party_decodes_the_bytes(message):
    proto = third_party_decoder(type(message))(encode(message))
    assert proto.header.producer == message.header.producer
    assert proto.header.sequence == message.header.sequence
    assert proto.header.tray == message.header.tray
    own_columns = columns(type(message))
    for f in fields(message):
        ours = getattr(message, f.name)
        theirs = getattr(proto.measured if f.name in BY_NAME else proto, f.name)
        if f.name in own_columns:
            assert same(ours.ravel(), np.asarray(list(theirs), dtype=own_columns[f.name].dtype)), f.name
        elif f.name != "header":
            assert agree(ours, theirs), f.name


@given(st.sampled_from(MESSAGE_TYPES), st.binary(max_size=200))
def test_any_bytes_are_refused_or_decoded(message_type, payload):
    with contextlib.suppress(CodecError):
        decode(message_type, payload)


def test_messages_records_and_columns_have_the_fields_of_the_schema_in_order_and_their_types():
    assert list(BY_NAME) == [f.name for f in fan_pb2.Measured.DESCRIPTOR.fields]
    for record in RECORDS:
        theirs = [f.name for f in getattr(fan_pb2, record.__name__).DESCRIPTOR.fields]
        assert [f.name for f in fields(record)] == theirs, record
    for message_type in MESSAGE_TYPES:
        schema = {f.name: f for f in proto_type(message_type).DESCRIPTOR.fields if f.name != "measured"}
        assert [f.name for f in fields(message_type) if f.name not in BY_NAME] == list(schema), message_type
        own = {name: column for name, column in columns(message_type).items() if not column.part}
        wire_types = {name: WIRE_TYPES[f.type] for name, f in schema.items() if f.is_repeated and f.type in WIRE_TYPES}
        assert {name: column.dtype for name, column in own.items()} == wire_types, message_type
        enums = {name: column.enum for name, column in own.items() if column.enum}
        enums |= {name: hint for name, hint in other_fields(message_type).items() if hint in ENUMS}
        their_enums = {name: f.enum_type.name for name, f in schema.items() if f.enum_type}
        assert {name: enum.__name__ for name, enum in enums.items()} == their_enums, message_type


@pytest.mark.parametrize("enum", ENUMS, ids=lambda enum: enum.__name__)
def test_an_enum_has_the_values_of_its_schema(enum):
    prefix = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", enum.__name__).upper()
    assert {f"{prefix}_{value.name}": value.value for value in enum} == dict(getattr(fan_pb2, enum.__name__).items())


def test_decoded_columns_are_read_only():
    back = decode(Command, encode(Command(fans=1, t_ns=0, command=np.ones(1), set_point_rad_s=np.ones(1))))
    assert isinstance(back, Command)
    with pytest.raises(ValueError, match="read-only"):
        back.command[0] = 2.0


@pytest.mark.parametrize("enum", ENUMS, ids=lambda enum: enum.__name__)
def test_an_enum_keeps_an_unknown_value_and_names_it(enum):
    unknown = enum(99)
    assert isinstance(unknown, enum) and not unknown.is_known
    assert (unknown, unknown.words, enum(0).is_known) == (99, "unknown (99)", True)
    assert unknown == enum(np.uint8(99)) and hash(unknown) == hash(enum(99))
    assert pickle.loads(pickle.dumps(unknown)) == unknown
    for value in (-1, 128, 300, "99", None):
        with pytest.raises(ValueError, match="is not a valid"):
            enum(value)


@LENGTHS
def test_unknown_values_of_a_newer_producer_survive_in_columns(samples):
    proto: Any = fan_pb2.Grid.FromString(encode(grid_of(samples)))
    proto.invalid_reason[samples // 2] = 99
    back = decode(Grid, proto.SerializeToString())
    assert back.invalid_reason.ravel()[samples // 2] == 99
    assert fan_pb2.Grid.FromString(encode(back)) == proto


def grid_of(samples: int) -> Grid:
    rng = np.random.default_rng(samples)
    speed = rng.normal(size=(samples, 2))
    speed[rng.random(speed.shape) < 0.1] = np.nan
    invalid_reason = rng.integers(0, 8, speed.shape).astype(np.uint8)
    columns = {"t_ns": np.arange(samples) + 10**18, "command": -speed, "speed_rad_s": speed}
    columns |= {"valid": invalid_reason == 0, "invalid_reason": invalid_reason, "reading_missing": np.isnan(speed)}
    return filled(Grid, samples, 2, period_ns=1, **columns)


@pytest.mark.parametrize("kind", [*fan_pb2.DESCRIPTOR.message_types_by_name.values()], ids=lambda kind: kind.name)
def test_fields_are_numbered_from_1_without_holes(kind):
    assert [f.number for f in kind.fields] == list(range(1, len(kind.fields) + 1))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"command": np.zeros(2)}, r"Grid\.command has shape \(2,\)"),
        ({"valid": np.zeros((0, 2), bool)}, r"Grid\.valid has shape \(0, 2\)"),
        ({"invalid_reason": np.full((1, 2), 128)}, r"Grid\.invalid_reason holds a value out of its limits"),
        ({"t_ns": np.array([2**62])}, "2116"),
        ({"t_ns": np.array([-(2**62)])}, "2116"),
        *(({"period_ns": period_ns}, "period_ns") for period_ns in (0, -1, 2**62)),
    ],
)
def test_what_does_not_fit_is_not_encoded(change, words):
    with pytest.raises(CodecError, match=words):
        encode(replace(grid_of(1), **change))


@LENGTHS
@pytest.mark.parametrize(
    ("column", "values"),
    [
        *(("invalid_reason", value) for value in (128, 300, -1)),
        *(("t_ns", value) for value in (2**62, -(2**62))),
        *(("period_ns", value) for value in (0, -1, 2**62)),
        ("command", None),
        ("fans", 3),
    ],
)
def test_what_does_not_fit_is_refused_in_a_block_of_any_length(samples, column, values):
    proto = fan_pb2.Grid.FromString(encode(grid_of(samples)))
    if values is None:
        proto.ClearField(column)
    elif isinstance(field := getattr(proto, column), int):
        setattr(proto, column, values)
    else:
        field[samples // 2] = values
    with pytest.raises(CodecError, match=r"Grid\.command" if column == "fans" else rf"Grid\.{column}"):
        decode(Grid, proto.SerializeToString())


def test_a_value_for_each_fan_and_an_enum_of_a_message_are_checked_like_columns():
    speeds: dict[str, Any] = dict.fromkeys(("command", "measured_speed_rad_s", "predicted_speed_rad_s"), (0.0,))
    without_sigma = fan_pb2.Prediction(fans=1, period_ns=1, t_ns=[1], **speeds)
    with pytest.raises(CodecError, match=r"Prediction.sigma_rad_s has shape \(0,\), not fans = \(1,\)"):
        decode(Prediction, without_sigma.SerializeToString())
    severity: Any = 300
    with pytest.raises(CodecError, match=r"Alarm\.severity"):
        decode(messages.Alarm, fan_pb2.Alarm(severity=severity).SerializeToString())


@given(st.one_of(any_message(Score), any_message(Prediction), any_message(Raw)), st.data())
def test_columns_that_are_named_are_as_decoded_in_full_and_others_are_empty(message: Message, data: st.DataObject):
    kind, payload = type(message), encode(message)
    names = data.draw(st.sets(st.sampled_from(sorted(columns(kind)))))
    read, full = decode(kind, payload, names), decode(kind, payload)
    for name in columns(kind):
        is_there = name in names or name == time_column(kind)
        assert same(getattr(read, name), getattr(full, name)) if is_there else not getattr(read, name).size
    assert all(same(getattr(read, name), getattr(full, name)) for name in other_fields(kind))


@pytest.mark.parametrize("fans", [0, 2])
def test_a_named_column_that_does_not_fit_the_samples_is_refused(fans: int):
    wrong = fan_pb2.Score(fans=fans, period_ns=10, t_ns=[5], score=[0.25, 0.5, 0.75])
    with pytest.raises(CodecError, match="score has"):
        decode(Score, wrong.SerializeToString(), ("score",))
