"""A new field of a message needs `fan.proto` and `messages.py` only: codec, blocks and export derive the rest.

The toy below adds an enum column, a quantity, an enum scalar and a nested record to `Score`, as an edit of those two
files would.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    EnumValueDescriptorProto,
    FileDescriptorProto,
)
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from fantwin.pipeline.recordings import read_arrays
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas import fan_pb2, messages
from fantwin.schemas.blocks import cut, join
from fantwin.schemas.codec import decode, encode
from fantwin.schemas.fields import Array, OpenEnum, column
from fantwin.schemas.topics import BY_NAME, tray_key
from tests.support.fantwin_command import fantwin
from tests.support.message_strategies import same
from tests.support.score_data import made_up_tray


class Bearing(OpenEnum):
    """The toy enum."""

    UNKNOWN = 0
    SMOOTH = 1
    ROUGH = 2


@dataclass(frozen=True, kw_only=True)
class Lubricant:
    """The toy record."""

    name: str
    bearing: Bearing


@dataclass(frozen=True, eq=False, kw_only=True)
class Score(messages.Score):
    """A score with four more fields."""

    bearing: Array = column("samples x fans", Bearing, optional=True)
    vibration_m_s2: Array = column("samples x fans", np.float64, optional=True)
    worst_bearing: Bearing = Bearing.UNKNOWN
    lubricants: tuple[Lubricant, ...] = ()


def changed_schema() -> FileDescriptorProto:
    """`fan.proto` with the toy's fields."""
    schema = FileDescriptorProto()
    fan_pb2.DESCRIPTOR.CopyToProto(schema)
    values = [EnumValueDescriptorProto(name=f"BEARING_{value.name}", number=value) for value in Bearing]
    schema.enum_type.append(EnumDescriptorProto(name="Bearing", value=values))
    enum: dict[str, Any] = {"type": Field.TYPE_ENUM, "type_name": ".fantwin.Bearing"}
    once: dict[str, Any] = {"label": Field.LABEL_OPTIONAL}
    many: dict[str, Any] = {"label": Field.LABEL_REPEATED}
    name = Field(name="name", number=1, type=Field.TYPE_STRING, **once)
    schema.message_type.append(
        DescriptorProto(name="Lubricant", field=[name, Field(name="bearing", number=2, **enum, **once)])
    )
    score = next(message for message in schema.message_type if message.name == "Score")
    score.field.extend(
        (
            Field(name="bearing", number=100, **enum, **many),
            Field(name="vibration_m_s2", number=101, type=Field.TYPE_DOUBLE, **many),
            Field(name="worst_bearing", number=102, **enum, **once),
            Field(name="lubricants", number=103, type=Field.TYPE_MESSAGE, type_name=".fantwin.Lubricant", **many),
        )
    )
    return schema


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Iterator[Score]:
    """A score of the changed schema, which is in force during the test."""
    (older, *_), _ = made_up_tray(seconds=1)
    pool = DescriptorPool()
    pool.AddSerializedFile(changed_schema().SerializeToString())
    monkeypatch.setattr(fan_pb2, "Score", GetMessageClass(pool.FindMessageTypeByName("fantwin.Score")))
    monkeypatch.setitem(BY_NAME, "score", replace(BY_NAME["score"], message=Score))
    shape = older.command.shape
    bearing = np.arange(np.prod(shape)).reshape(shape) % 3
    yield Score(
        **vars(older),
        bearing=bearing.astype(np.uint8),
        vibration_m_s2=bearing * 0.5,
        worst_bearing=Bearing.ROUGH,
        lubricants=(Lubricant(name="oil", bearing=Bearing.SMOOTH), Lubricant(name="grease", bearing=Bearing(77))),
    )


def test_a_new_field_is_encoded_decoded_cut_and_joined(toy):
    for found in (decode(Score, encode(toy)), join([cut(toy, 0, 3), cut(toy, 3, len(toy.t_ns))])):
        assert all(same(getattr(toy, name), getattr(found, name)) for name in vars(toy))


def test_a_new_field_is_exported_with_its_words(tmp_path: Path, toy):
    path = tmp_path / "r.mcap"
    with RecordingWriter(path, {"site": "plant"}) as writer:
        writer.add_message(tray_key("plant", "tray1", "score"), toy, 1)
    (block,) = read_arrays(path, "score")
    assert same(block["bearing"], toy.bearing)
    table = tmp_path / "scores.csv"
    assert fantwin("export", path, "--to", "csv", "-o", table).exit_code == 0
    frame = pd.read_csv(table)
    assert frame["bearing"].tolist() == [Bearing(value).name for value in toy.bearing.ravel()]
    assert frame["vibration_m_s2"].tolist() == toy.vibration_m_s2.ravel().tolist()
    assert set(frame["worst_bearing"]) == {"ROUGH"}
    assert "lubricants" not in frame
