"""deploy/foxglove/fan.json: every topic and field of the layout exists, as the schema in a recording describes it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from fantwin.schemas import fan_pb2
from fantwin.schemas.codec import type_name
from fantwin.schemas.topics import BY_NAME, tray_key

LAYOUT = Path(__file__).parents[2] / "deploy" / "foxglove" / "fan.json"
FUNCTIONS = {"abs", "sqrt"}
"""of Foxglove, see its page "Message path syntax" """
PATH = re.compile(
    r"(?P<topic>[\w/-]+)(?P<filter>\{(\w+)==\$(\w+)\})?(?P<fields>(\.\w+(\[[^\]]*\])?)*)(?P<functions>(\.@\w+)*)"
)


def layout() -> dict[str, Any]:
    return json.loads(LAYOUT.read_text(encoding="utf-8"))


def paths(value: Any) -> Iterator[str]:
    """Every message path in the configuration of a panel."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key in ("value", "topicPath"):
                yield inner
            else:
                yield from paths(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from paths(inner)


def resolve(path: str, variables: set[str]) -> FieldDescriptor | Descriptor:
    """What a message path leads to.

    Raises:
        LookupError: it leads nowhere.
    """
    match = PATH.fullmatch(path)
    if match is None:
        raise LookupError(f"{path}: not a message path")
    topic = match["topic"].rpartition("/")[2]
    if topic not in BY_NAME or match["topic"] != tray_key("demo", "tray1", topic):
        raise LookupError(f"{path}: no such topic")
    message: Descriptor = fan_pb2.DESCRIPTOR.message_types_by_name[type_name(BY_NAME[topic].message).rpartition(".")[2]]
    if match["filter"] and (match[3] not in message.fields_by_name or match[4] not in variables):
        raise LookupError(f"{path}: nothing to filter by")
    found: FieldDescriptor | Descriptor = message
    for name, index in re.findall(r"\.(\w+)(\[[^\]]*\])?", match["fields"]):
        inside = found if isinstance(found, Descriptor) else found.message_type
        if inside is None:
            raise LookupError(f"{path}: {found.name} has no fields")
        if name not in inside.fields_by_name:
            raise LookupError(f"{path}: {inside.name} has no field {name}")
        found = inside.fields_by_name[name]
        if found.is_repeated != bool(index) or (index.startswith("[$") and index[2:-1] not in variables):
            raise LookupError(f"{path}: {name}{index}: not an index of it")
    if unknown := set(re.findall(r"@(\w+)", match["functions"])) - FUNCTIONS:
        raise LookupError(f"{path}: unknown functions {unknown}")
    return found


def test_every_path_leads_to_a_field_of_the_schema() -> None:
    document = layout()
    variables = set(document["globalVariables"])
    found = [path for path in paths(document["configById"]) if not path.isdecimal()]
    leads_to = {path: resolve(path, variables) for path in found}
    fields = {field.name for field in leads_to.values()}
    assert {"measured_speed_rad_s", "predicted_speed_rad_s", "band_variance", "score", "state", "severity"} <= fields
    for path in paths(document["configById"]["StateTransitions!states"]):
        field = leads_to[path]
        assert isinstance(field, FieldDescriptor) and field.enum_type is not None, "shown by its name"


def panels(node: Any) -> list[str]:
    return [node] if isinstance(node, str) else [*panels(node["first"]), *panels(node["second"])]


def test_every_panel_is_placed_once_and_has_a_configuration() -> None:
    document = layout()
    assert sorted(panels(document["layout"])) == sorted(document["configById"])
