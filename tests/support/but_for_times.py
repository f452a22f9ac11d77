"""What commands print and write, without the times that the work took, so that it can be compared byte for byte."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import onnx

from fantwin.schemas.twin_card import CARD_PROPERTY

TIMES = {"created", "duration_s", "training_s", "took_s", "times_real_time"}


def but_for_times(value: Any) -> Any:
    """A JSON value without the times that the work took."""
    if isinstance(value, dict):
        return {key: but_for_times(of_key) for key, of_key in value.items() if key not in TIMES}
    return [but_for_times(item) for item in value] if isinstance(value, list) else value


def content_of(path: Path) -> bytes:
    """A file that a command wrote, but for times."""
    if path.suffix == ".json":
        return json.dumps(but_for_times(json.loads(path.read_text(encoding="utf-8")))).encode()
    if path.suffix != ".onnx":
        return path.read_bytes()
    file = onnx.load(path)
    properties = {entry.key: entry.value for entry in file.metadata_props}
    properties[CARD_PROPERTY] = json.dumps(but_for_times(json.loads(properties[CARD_PROPERTY])))
    onnx.helper.set_model_props(file, properties)
    return file.SerializeToString(deterministic=True)
