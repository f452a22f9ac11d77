"""deploy/foxglove/fan.json: every topic and field of the layout exists, as the schema in a recording describes it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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


def resolve(path: str, variables: set[str]) -> Any:
    """The message or the field that a path leads to; a LookupError names the first part that is not there."""
    match = PATH.fullmatch(path)
    assert match, f"{path}: not a message path"
    topic = match["topic"].rpartition("/")[2]
    assert match["topic"] == tray_key("demo", "tray1", topic)
    message: Any = fan_pb2.DESCRIPTOR.message_types_by_name[type_name(BY_NAME[topic].message).rpartition(".")[2]]
    if match["filter"]:
        assert match[3] in message.fields_by_name and match[4] in variables, f"{path}: nothing to filter by"
    found = message
    for name, index in re.findall(r"\.(\w+)(\[[^\]]*\])?", match["fields"]):
        found = message.fields_by_name[name]
        assert found.is_repeated == bool(index), f"{path}: {name}{index}: not an index of it"
        assert not index.startswith("[$") or index[2:-1] in variables
        message = found.message_type
    assert set(re.findall(r"@(\w+)", match["functions"])) <= FUNCTIONS
    return found


def test_every_path_leads_to_a_field_of_the_schema() -> None:
    document = layout()
    variables = set(document["globalVariables"])
    found = [path for path in paths(document["configById"]) if not path.isdecimal()]
    leads_to = {path: resolve(path, variables) for path in found}
    fields = {field.name for field in leads_to.values()}
    assert {"measured_speed_rad_s", "predicted_speed_rad_s", "band_variance", "score", "state", "severity"} <= fields
    for path in paths(document["configById"]["StateTransitions!states"]):
        assert leads_to[path].enum_type is not None, "shown by its name"


def panels(node: Any) -> list[str]:
    return [node] if isinstance(node, str) else [*panels(node["first"]), *panels(node["second"])]


def test_every_panel_is_placed_once_and_has_a_configuration() -> None:
    document = layout()
    assert sorted(panels(document["layout"])) == sorted(document["configById"])
