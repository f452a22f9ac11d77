"""A Grafana dashboard checked against Grafana's own schema, in the form of its Foundation SDK for Python."""

from __future__ import annotations

import json
import types
import typing
from collections.abc import Iterator, Mapping
from enum import Enum
from typing import Any

import pytest


def problems_of(board: Mapping[str, Any]) -> list[str]:
    """Fields that the schema does not have, and values of another type than it says."""
    sdk = pytest.importorskip("grafana_foundation_sdk.models.dashboard", reason="grafana-foundation-sdk of `dev`")
    from grafana_foundation_sdk.cog.encoder import JSONEncoder  # type: ignore[import-not-found]  # noqa: PLC0415
    from grafana_foundation_sdk.cog.plugins import (  # type: ignore[import-not-found]  # noqa: PLC0415
        register_default_plugins,
    )

    register_default_plugins()  # the options of each kind of panel, the queries of each kind of source
    read = sdk.Dashboard.from_json(board)
    written = json.loads(json.dumps(read, cls=JSONEncoder))
    return [*_lost(board, written, "board"), *_wrong_fields(read, "board")]


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


def _wrong_fields(value: Any, where: str) -> Iterator[str]:
    for name, hint in typing.get_type_hints(type(value)).items():
        field = getattr(value, name, None)
        if field is not None:
            yield from _wrong(field, hint, f"{where}.{name}")


def _wrong(value: Any, hint: Any, where: str) -> Iterator[str]:
    """Where a value is not of its type."""
    kind, parts = typing.get_origin(hint), typing.get_args(hint)
    if kind in (typing.Union, types.UnionType):
        found = [list(_wrong(value, part, where)) for part in parts if part is not types.NoneType]
        if all(found):
            yield from max(found, key=lambda problems: len(problems[0].partition(": ")[0]))  # that it fits best
    elif kind is list and isinstance(value, list):
        for number, each in enumerate(value):
            yield from _wrong(each, parts[0], f"{where}[{number}]")
    elif kind is dict and isinstance(value, dict):
        for name, each in value.items():
            yield from _wrong(each, parts[1], f"{where}.{name}")
    elif kind is typing.Literal or (isinstance(hint, type) and issubclass(hint, Enum)):
        allowed = parts or [each.value for each in hint]
        if value not in allowed:
            yield f"{where}: {value!r} is none of {allowed}"
    elif isinstance(value, dict) and hasattr(hint, "from_json"):  # which the SDK has left as it was
        yield from _wrong_fields(hint.from_json(value), where)
    elif hint not in (Any, object) and not isinstance(value, (int, float) if hint is float else kind or hint):
        yield f"{where}: {value!r} is no {hint}"
    elif hasattr(value, "to_json"):
        yield from _wrong_fields(value, where)
