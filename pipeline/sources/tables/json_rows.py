"""JSON as rows of a table: an object a line, or a list of objects, with the keys of nested ones joined by points."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from fantwin.pipeline.errors import UserError

MOST_BYTES = 512 << 20
_MOST_KEYS = 10_000
_START = re.compile(r"\ufeff?\s*(\{|\[\s*[\[{])")
_LONGEST_TEXT = 40


def is_json(start: str) -> bool:
    """Whether a file begins as JSON with objects."""
    return bool(_START.match(start))


def json_rows(path: Path) -> Iterator[list[str]]:
    """The keys of all objects, and the values of each, in their order. Raises UserError."""
    names: dict[str, int] = {}
    for record in _records(path):
        for name in record:
            names.setdefault(name, len(names))
        if len(names) > _MOST_KEYS:
            raise UserError(f"{path}: JSON with more than {_MOST_KEYS:,} keys, which is no table")
    yield list(names)
    for record in _records(path):
        row = [""] * len(names)
        for name, value in record.items():
            row[names[name]] = value
        yield row


def _records(path: Path) -> Iterator[Mapping[str, str]]:
    """Keys and values of each object; of a damaged line its text, under no key."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        lines = (line for line in file if line.strip())
        first, second = next(lines, ""), next(lines, "")
        if isinstance(_loaded(first), Mapping) and second:
            for line in (first, second, *lines):
                found = _loaded(line)
                yield dict(_flat(found)) if isinstance(found, Mapping) else {"": line.strip()[:_LONGEST_TEXT]}
            return
    if path.stat().st_size > MOST_BYTES:
        raise UserError(f"{path}: larger than {MOST_BYTES >> 20} MiB; write an object a line, with `jq -c '.[]'`")
    whole = _loaded(path.read_text(encoding="utf-8-sig", errors="replace"))
    if whole is None:
        raise UserError(f"{path}: damaged JSON, or cut off: `jq . {path.name}` names the place")
    lists = whole.values() if isinstance(whole, Mapping) else [whole]
    rows = next((each for each in map(_in_one, lists) if len(each) > 1), None)
    if rows is None:
        raise UserError(
            f"{path}: JSON, of which an object a line or a list of objects is read, and this is neither: "
            f"make one, for example with `jq -c '.KEY[]' {path.name} > rows.jsonl`"
        )
    yield from (dict(_flat(each)) for each in rows)


def _loaded(text: str) -> Any:
    """The value in a text, its numbers as they are written; None: it is no JSON."""
    try:
        return json.loads(text, parse_float=str, parse_int=str)
    except (ValueError, RecursionError):
        return None


def _in_one(value: Any) -> list[Mapping[str, Any]]:
    """The objects of a list, or of lists within it; none: it has others. Home Assistant names an entity only in the
    first object of its list."""
    found: list[Mapping[str, Any]] = []
    for part in value if isinstance(value, list) else ():
        inner = part if isinstance(part, list) else [part]
        if not all(isinstance(each, Mapping) for each in inner):
            return []
        named = {key: inner[0][key] for key in ("entity_id",) if inner and key in inner[0]}
        found += [named | each for each in inner]
    return found


def _flat(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    if isinstance(value, Mapping):
        for key, each in value.items():
            yield from _flat(each, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list):
        for k, each in enumerate(value):
            yield from _flat(each, f"{name}[{k}]")
    else:
        yield name, "" if value is None else str(int(value)) if isinstance(value, bool) else str(value)
