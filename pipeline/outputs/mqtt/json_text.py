"""JSON that any program reads: JSON has no infinite numbers and no NaN."""

from __future__ import annotations

import json
import math
from typing import Any


def json_text(value: Any) -> str:
    """One line, without spaces; numbers that JSON has not are null."""
    try:
        return json.dumps(value, separators=(",", ":"), allow_nan=False)
    except ValueError:
        return json.dumps(_finite(value), separators=(",", ":"), allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
