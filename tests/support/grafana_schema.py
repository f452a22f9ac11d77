"""A Grafana dashboard checked against Grafana's own schema, in the form of its Foundation SDK for Python."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import pytest


def problems_of(board: Mapping[str, Any]) -> list[str]:
    """Fields that the schema does not have, and values that it reads as others."""
    sdk = pytest.importorskip("grafana_foundation_sdk.models.dashboard", reason="grafana-foundation-sdk of `dev`")
    from grafana_foundation_sdk.cog.encoder import JSONEncoder  # type: ignore[import-not-found]  # noqa: PLC0415
    from grafana_foundation_sdk.cog.plugins import register_default_plugins  # type: ignore[import-not-found]  # noqa: PLC0415

    register_default_plugins()  # the options of each kind of panel, the queries of each kind of source
    read = sdk.Dashboard.from_json(board)
    written = json.loads(json.dumps(read, cls=JSONEncoder))
    return [*_lost(board, written, "board")]


def _lost(had: Any, has: Any, where: str) -> Iterator[str]:
    """What the schema does not know: it is not written again."""
    if isinstance(had, dict) and isinstance(has, dict):
        for name, value in had.items():
            if name in has:
                yield from _lost(value, has[name], f"{where}.{name}")
            else:
                yield f"{where}.{name} is not in the schema"
    elif isinstance(had, list) and isinstance(has, list) and len(had) == len(has):
        for number, (one, other) in enumerate(zip(had, has, strict=True)):
            yield from _lost(one, other, f"{where}[{number}]")
    elif had != has:
        yield f"{where}: {had!r} is read as {has!r}"
