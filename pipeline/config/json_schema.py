"""A JSON schema of fantwin.toml, from the models that check it: editors complete keys and mark mistakes by it.

What one key says of another, only `fantwin doctor` checks. `make reference` writes docs/reference/fantwin.schema.json.
"""

from __future__ import annotations

import json
from typing import Any

from pydantic import create_model

from fantwin.pipeline.config.hosts import ABOUT
from fantwin.pipeline.config.loading import File
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.sources.kinds import SOURCE_KINDS, source_config
from fantwin.pipeline.sources.source import SourceConfig

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def schema_text() -> str:
    """The schema, as it is written to a file."""
    sections: dict[str, Any] = {name: (row.load().config | None, None) for name, row in STAGES.items()}
    sources: dict[str, Any] = {f"source_{kind}": (source_config(kind) | None, None) for kind in SOURCE_KINDS}
    whole = create_model("Configuration", __base__=File, **sections, **sources).model_json_schema()
    made = whole["$defs"]
    kinds = [_only(whole["properties"].pop(name)) for name in sources]
    for name in STAGES:
        whole["properties"][name] = _only(whole["properties"][name])
    for kind, reference in zip(SOURCE_KINDS, kinds, strict=True):
        model = made[reference["$ref"].rpartition("/")[2]]
        model["properties"]["kind"] = {"const": kind, "description": "what the source is"}
        model["required"] = ["kind", *(key for key in model.get("required", ()) if key != "kind")]
    made[SourceConfig.__name__] = {"oneOf": kinds}
    tray, serial = made[TrayConfig.__name__], made[source_config("serial").__name__]["properties"]
    for key in TrayConfig.short_form_keys:
        tray["properties"][key] = serial[key]
    number = tray["properties"]["fans"]
    names = {"type": "array", "minItems": 1, "items": {"type": "string"}}
    about_fans = {key: number.pop(key) for key in ("title", "description")}
    tray["properties"]["fans"] = {**about_fans, "anyOf": [number, names]}
    several = {"type": "array", "minItems": 1, "items": {"anyOf": [{"type": "string"}, {"type": "object"}]}}
    tray["properties"]["hosts"] = {"description": ABOUT, **several}
    tray["required"] = [key for key in tray["required"] if key not in ("fans", "name")]
    tray["allOf"] = [
        {"anyOf": [{"required": ["fans"]}, {"required": ["fan"]}]},
        {"anyOf": [{"required": ["name"]}, {"required": ["hosts"]}]},
    ]
    about = "The configuration of a fantwin site: docs/reference/configuration.md."
    return json.dumps({"$schema": DIALECT, **whole, "title": "fantwin.toml", "description": about}, indent=1) + "\n"


def _only(value: dict[str, Any]) -> dict[str, Any]:
    """The schema of a model that may be left out, which is all that may be said of it in TOML: it has no null."""
    (model,) = (each for each in value["anyOf"] if each.get("type") != "null")
    return model
