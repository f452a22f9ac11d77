"""A twin file with other entries in its card: the graph and its weights are unchanged."""

import json
from collections.abc import Mapping
from typing import Any

import onnx

from fantwin.schemas.twin_card import CARD_PROPERTY
from fantwin.twin.errors import TwinError


def with_card_entries(content: bytes, entries: Mapping[str, Any]) -> bytes:
    """The same ONNX file with other entries in its card, such as its calibration or its name.

    Raises:
        TwinError: it is no twin.
    """
    model = onnx.load_model_from_string(content)
    for entry in model.metadata_props:
        if entry.key == CARD_PROPERTY:
            card = json.loads(entry.value)
            entry.value = json.dumps({**card, **entries}, allow_nan=False)
            return model.SerializeToString()
    raise TwinError(f"an ONNX file, but not a twin: it has no {CARD_PROPERTY}")
