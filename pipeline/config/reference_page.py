"""docs/reference/configuration.md: every key of the configuration, from the models that check it.

`python -m fantwin.pipeline.config.reference_page` writes the page to standard output, `make reference` the file.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Iterator
from functools import reduce
from importlib import import_module
from operator import or_
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from fantwin.pipeline.config.loading import LARGEST_FILE_BYTES, top_level
from fantwin.pipeline.config.models import BusConfig, LauncherConfig, SecurityConfig, TrayConfig
from fantwin.pipeline.config.registry import STAGES
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
_TYPE_WORDS = {str: "text", int: "integer", float: "number", bool: "`true` or `false`", Path: "path"}
_ELSEWHERE = "see below"
_BOUNDS = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}


def page() -> str:
    """The page, in Markdown."""
    tables = ("bus", "launcher", "tray")
    parts = [
        _INTRODUCTION,
        "## The file\n",
        table(top_level(), but=tables),
        "## `[[tray]]`\n",
        "One for each tray. `port`, `baud` and `protocol` may be written in it directly, for a serial source.\n",
        table(TrayConfig),
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
    for kind, row in SOURCE_KINDS.items():
        module, _, name = row.config.partition(":")
        model: type[BaseModel] = getattr(import_module(module), name)
        has_keys = set(model.model_fields) > {"kind"}
        yield f'### `source = {{ kind = "{kind}"{", ..." if has_keys else ""} }}`\n'
        yield table(model, but=("kind",)) if has_keys else "It has no other keys.\n"
        yield from tables_within(model)


def tables_within(model: type[BaseModel]) -> Iterator[str]:
    """The keys of the tables that are values of keys of a source or a stage, each kind of table once."""
    waiting, shown = [model], set[type[BaseModel]]()
    while waiting:
        for key, field in waiting.pop(0).model_fields.items():
            inner = next(filter(_is_model, _plain_types(field.annotation)), None)
            if inner is not None and inner not in shown:
                shown.add(inner)
                waiting.append(inner)
                yield f"A table such as `{key}`: {(inner.__doc__ or '').splitlines()[0]}\n"
                yield table(inner)


def _plain_types(annotation: Any) -> Iterator[Any]:
    """The types that an annotation is made of."""
    arguments = get_args(annotation)
    for each in arguments:
        yield from _plain_types(each)
    if not arguments:
        yield annotation


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def table(model: type[BaseModel], but: Iterable[str] = ()) -> str:
    """The keys of a section, one a row."""
    rows = [
        f"| `{key}` | {_values(field)} | {_default(field)} | {field.description or ''} |"
        for key, field in model.model_fields.items()
        if key not in but
    ]
    return "\n".join(["| key | value | default | |", "|---|---|---|---|", *rows, ""])


def _values(field: FieldInfo) -> str:
    arguments = get_args(field.annotation)
    is_optional = NoneType in arguments
    annotation = reduce(or_, (each for each in arguments if each is not NoneType)) if is_optional else None
    bounds = [
        f"{words} {_number(getattr(rule, name))}"
        for rule in field.metadata
        for name, words in _BOUNDS.items()
        if getattr(rule, name, None) is not None
    ]
    return ", ".join([_type_words(annotation if is_optional else field.annotation), *bounds])


def _type_words(annotation: Any) -> str:
    origin, arguments = get_origin(annotation), get_args(annotation)
    words = _TYPE_WORDS.get(annotation, _ELSEWHERE)
    if origin is Annotated:
        words = _type_words(arguments[0])
    elif origin is Literal:
        words = " or ".join(f"`{json.dumps(value)}`" for value in arguments)
    elif origin is UnionType:
        words = " or ".join(map(_type_words, arguments))
    elif origin is dict:
        words = f"table of {_type_words(arguments[1])}s"
    elif origin is tuple:
        of_one = _type_words(arguments[0])
        words = of_one if of_one == _ELSEWHERE else "list of tables" if of_one == "table" else f"list of {of_one}"
    elif _is_model(annotation) and annotation not in (SourceConfig, Tacho):
        words = "table"
    return words


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    if field.default is None or field.default == {} or _is_of_models(field.default):
        return ""
    if isinstance(field.default, dict):
        return "`{ " + ", ".join(f"{key} = {json.dumps(value)}" for key, value in field.default.items()) + " }`"
    value = str(field.default) if isinstance(field.default, Path) else field.default
    return (
        _number(value) if isinstance(value, int | float) and not isinstance(value, bool) else f"`{json.dumps(value)}`"
    )


def _is_of_models(value: Any) -> bool:
    """Whether it is a table, or a list of tables, whose keys say their own defaults."""
    return isinstance(value, BaseModel) or (isinstance(value, tuple) and any(map(_is_of_models, value)))


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else str(value)


if __name__ == "__main__":
    sys.stdout.write(page())
