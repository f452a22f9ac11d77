"""docs/reference/configuration.md: every key of the configuration, from the models that check it.

`python -m fantwin.pipeline.config.reference_page` writes the page to standard output, `make reference` the file.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Iterator
from importlib import import_module
from itertools import chain
from typing import Any

from pydantic import BaseModel

from fantwin.pipeline.config.hosts import ABOUT
from fantwin.pipeline.config.loading import LARGEST_FILE_BYTES, File
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import BusConfig, FanConfig, LauncherConfig, SecurityConfig, TrayConfig
from fantwin.pipeline.sources.kinds import SOURCE_KINDS
from fantwin.pipeline.sources.source import SourceConfig
from fantwin.schemas.tacho import Tacho

_INTRODUCTION = f"""# Configuration

One TOML file of at most {LARGEST_FILE_BYTES >> 20} MiB holds the settings of a site. Only a `[[tray]]` with `name` and
`fans` is required. Unknown keys are refused, with the nearest known one. Keys that end in `_s` are in seconds. Relative
paths start at the folder of the file. `--set` changes a key for one command: `--set scorer.alarm_share=1.0`,
`--set tray.0.port=/dev/ttyUSB1`. `fantwin doctor -c FILE` checks a file.

Where the default is empty, the description says what holds; times of the `[scorer]` are then those that the twin was
calibrated with.

This page is made from the models in the code: `make reference`.
"""
Schema = dict[str, Any]
"""of JSON, as pydantic makes it"""
_TYPE_WORDS = {
    **{"string": "text", "integer": "integer", "number": "number", "boolean": "`true` or `false`"},
    **{"path": "path"},
}
_ELSEWHERE = "see below"
_SHOWN_BELOW = (SourceConfig.__name__, Tacho.__name__, FanConfig.__name__)
_BOUNDS = {"exclusiveMinimum": "above", "minimum": "at least", "exclusiveMaximum": "below", "maximum": "at most"}


def page() -> str:
    """The page, in Markdown."""
    tables = ("bus", "launcher", "tray")
    parts = [
        _INTRODUCTION,
        "## The file\n",
        table(File, but=tables),
        "## `[[tray]]`\n",
        "One for each tray. `port`, `baud` and `protocol` may be written in it directly, for a serial source.\n",
        f"`hosts`, {ABOUT}.\n",
        table(TrayConfig),
        "### `[[tray.fan]]`\n",
        table(FanConfig),
        *_sources(),
        "### `tacho = { kind = ..., ... }`\n",
        "What a reading is of the speed ([tachos](../explanation/tachos.md)).\n",
        table(Tacho),
        "## `[bus]`\n",
        table(BusConfig, but=("security", "zenoh")),
        "## `[bus.security]`\n",
        "Certificates and roles ([security](../how-to/security.md)). Without this section there are none.\n",
        table(SecurityConfig),
        "## `[bus.zenoh]`\n",
        "Settings of Zenoh itself, passed to every session and to the router: path = value, with the paths of Zenoh's "
        'own configuration, for example `"transport/unicast/max_sessions" = 5000`. What Zenoh does not know, or '
        "fantwin sets itself, is refused.\n",
        "## `[launcher]`\n",
        table(LauncherConfig),
    ]
    for name, row in STAGES.items():
        stage = row.load()
        start = {
            "default": "",
            "section": " It runs if the file has this section.",
            "tray without twin": " It runs if a tray names no twin, or if the file has this section.",
        }[row.enabled_by]
        if row.extra:
            start += f" If the extra `{row.extra}` is not installed, `fantwin up` leaves out this stage and says so."
        parts += [
            f"## `[{name}]`\n",
            f"{stage.about[0].upper()}{stage.about[1:]}.{start}\n",
            table(stage.config),
            *tables_within(stage.config),
        ]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(parts))


def _sources() -> Iterator[str]:
    shown: dict[str, str] = {}
    rows: dict[str, str] = {}
    for kind, row in SOURCE_KINDS.items():
        module, _, name = row.config.partition(":")
        model: type[BaseModel] = getattr(import_module(module), name)
        has_keys = set(model.model_fields) > {"kind"}
        yield f'### `source = {{ kind = "{kind}"{", ..." if has_keys else ""} }}`\n'
        yield _table_of_new(table(model, but=("kind",)), rows, kind) if has_keys else "It has no other keys.\n"
        yield from tables_within(model, shown, f" of `{kind}`")


def tables_within(model: type[BaseModel], shown: dict[str, str] | None = None, of: str = "") -> Iterator[str]:
    """The keys of the tables that are values of keys of a source or a stage, each kind of table once.

    shown: those that were shown before, and of what, which is `of` from here on.
    """
    schema = model.model_json_schema()
    waiting, shown = [schema], {} if shown is None else shown
    while waiting:
        for key, value in waiting.pop(0)["properties"].items():
            name = next(_models_in(value), None)
            if name is not None and shown.get(name, of) != of:
                yield f"`{key}` is such a table as that{shown[name]}.\n"
            elif name is not None and name not in shown:
                shown[name] = of
                inner = schema["$defs"][name]
                waiting.append(inner)
                yield f"A table such as `{key}`: {inner['description'].splitlines()[0]}\n"
                yield _rows(inner)


def _table_of_new(text: str, known: dict[str, str], kind: str) -> str:
    """The table of a kind, where keys that are the same as those of kinds above are only named. known: kind by row."""
    heads, rows = text.splitlines()[:2], text.splitlines()[2:]
    same: dict[str, list[str]] = {}
    for row in rows:
        if known.setdefault(row, kind) != kind:
            same.setdefault(known[row], []).append(row.split(" | ")[0].removeprefix("| "))
    also = "; ".join(f"{', '.join(keys)} as of `{of}`" for of, keys in same.items())
    new = [row for row in rows if known[row] == kind]
    return "\n".join([*heads, *new, *([f"\nAnd {also}."] if also else []), ""])


def table(model: type[BaseModel], but: Iterable[str] = ()) -> str:
    """The keys of a section, one a row."""
    return _rows(model.model_json_schema(), but)


def _rows(schema: Schema, but: Iterable[str] = ()) -> str:
    rows = [
        f"| `{key}` | {_values(value)} | {_default(value, is_required=key in schema.get('required', ()))} "
        f"| {value.get('description', '')} |"
        for key, value in schema["properties"].items()
        if key not in but
    ]
    return "\n".join(["| key | value | default | |", "|---|---|---|---|", *rows, ""])


def _values(value: Schema) -> str:
    """What a key may be: its types, and their bounds."""
    options = _options(value)
    bounds = [f"{words} {_number(each[name])}" for each in options for name, words in _BOUNDS.items() if name in each]
    return ", ".join([" or ".join(dict.fromkeys(map(_type_words, options))), *bounds])


def _options(value: Schema) -> list[Schema]:
    """The schemas of which a value has one; that there may be none is said by its default."""
    return [each for each in value.get("anyOf", [value]) if each.get("type") != "null"]


def _type_words(value: Schema) -> str:
    if name := next(_models_in(value), None):
        return _ELSEWHERE if name in _SHOWN_BELOW else "list of tables" if value.get("type") == "array" else "table"
    if choices := value.get("enum", [value["const"]] if "const" in value else []):
        return " or ".join(f"`{json.dumps(each)}`" for each in choices)
    if value["type"] == "array":
        items = value["items"]
        return f"list of {' or '.join(dict.fromkeys(map(_type_words, items.get('anyOf', [items]))))}"
    if value["type"] == "object":
        return f"table of {_type_words(value['additionalProperties'])}s"
    return _TYPE_WORDS[value.get("format") or value["type"]]


def _models_in(value: Any) -> Iterator[str]:
    """The names of the models that a schema refers to."""
    if isinstance(value, dict):
        if "$ref" in value:
            yield value["$ref"].rpartition("/")[2]
        yield from chain.from_iterable(map(_models_in, value.values()))
    elif isinstance(value, list):
        yield from chain.from_iterable(map(_models_in, value))


def _default(value: Schema, *, is_required: bool) -> str:
    default = value.get("default")
    if is_required:
        return "required"
    models = set(_models_in(value)) - {SourceConfig.__name__}  # the keys of others say their own defaults
    if default is None or default == {} or (default and models):
        return ""
    if isinstance(default, dict):
        return "`{ " + ", ".join(f"{key} = {json.dumps(each)}" for key, each in default.items()) + " }`"
    is_number = isinstance(default, int | float) and not isinstance(default, bool)
    return _number(default) if is_number else f"`{json.dumps(default)}`"


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else str(value)


if __name__ == "__main__":
    sys.stdout.write(page())
