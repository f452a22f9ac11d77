"""The metadata of an ONNX file, read without onnx or onnxruntime: a process that needs a twin's card loads neither."""

from __future__ import annotations

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

_FIELD = descriptor_pb2.FieldDescriptorProto


def read_onnx_metadata(content: bytes) -> dict[str, str]:
    """The metadata properties of an ONNX file; all else in it is skipped.

    Raises:
        ValueError: it is not an ONNX file.
    """
    return {entry.key: entry.value for entry in _parsed(content).metadata_props}


def without_metadata(content: bytes) -> bytes:
    """An ONNX file without its metadata properties: equal for files of the same graph and weights.

    Raises:
        ValueError: it is not an ONNX file.
    """
    model = _parsed(content)
    model.ClearField("metadata_props")
    return model.SerializeToString()


def _parsed(content: bytes) -> Any:
    try:
        return _MODEL.FromString(content)
    except DecodeError as error:
        raise ValueError("not an ONNX file") from error


def _model_message() -> Any:
    """The message ModelProto of onnx.proto with the one field needed here. Field numbers are those of onnx.proto."""
    file = descriptor_pb2.FileDescriptorProto(
        name="fantwin_onnx_metadata.proto", package="fantwin_onnx", syntax="proto3"
    )
    entry = file.message_type.add(name="StringStringEntryProto")
    for number, name in enumerate(("key", "value"), start=1):
        entry.field.add(name=name, number=number, type=_FIELD.TYPE_STRING, label=_FIELD.LABEL_OPTIONAL)
    file.message_type.add(name="ModelProto").field.add(
        name="metadata_props",
        number=14,
        type=_FIELD.TYPE_MESSAGE,
        type_name=".fantwin_onnx.StringStringEntryProto",
        label=_FIELD.LABEL_REPEATED,
    )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("fantwin_onnx.ModelProto"))


_MODEL = _model_message()
