"""What `fantwin init` finds: devices whose fans could be watched, each as a [[tray]] of a configuration."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.host_address import by_numbers, hosts_of, ranges_of
from fantwin.schemas.fan_names import is_fan_name

HIGHEST_RPM = 50_000
Config = TypeVar("Config", bound=BaseModel)
AT_ONCE = 32
"""devices that are asked at the same time"""


@dataclass(frozen=True)
class Found:
    """Possible tray: a chip with fans, a serial port, a controller.

    Attributes:
        kind: of its source.
        title: one line.
        tray: the keys of its [[tray]]; empty if it cannot be one.
        notes: what to know of it.
        missing: what keeps it from being watched, or commanded, and what to do.
    """

    kind: str
    title: str
    tray: Mapping[str, Any]
    notes: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()

    @property
    def fans(self) -> int:
        """The number of fans of the tray."""
        fans = self.tray.get("fans", self.tray.get("fan", ()))
        return fans if isinstance(fans, int) else len(fans)

    @property
    def toml(self) -> str:
        """The [[tray]], with what to know as comments; empty if it cannot be one."""
        if not self.tray:
            return ""
        lines = [f"# {line}" for line in (self.title, *self.notes, *self.missing)]
        return "\n".join(["[[tray]]", *lines, *(f"{key} = {as_toml(value)}" for key, value in self.tray.items()), ""])


def keys_in_rpm(name: str, called: Sequence[str], command_max: float, source: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of a tray whose fans a device calls so; their number where that can be no names."""
    are_names = all(map(is_fan_name, called)) and len({each.casefold() for each in called}) == len(called)
    return {
        "name": name,
        "fans": list(called) if are_names else len(called),
        "speed_unit": "rpm",
        "speed_max": HIGHEST_RPM,
        "command_max": command_max,
        "source": source,
    }


def checked(model: type[Config], settings: Mapping[str, Any], option: str, url: str) -> Config:
    """The settings of a source. Raises UserError, which names the option with the URL."""
    _require_no_password(option, url)
    try:
        return model.model_validate(settings)
    except ValidationError as error:
        raise UserError(f"{option} {url}: {error.errors()[0]['msg'].removeprefix('Value error, ')}") from error


def found_at(
    option: str, url: str, discover: Callable[[str], Found], host_of: Callable[[Mapping[str, Any]], str]
) -> list[Found]:
    """The device at a URL, or those of a range: one tray for all that are alike. host_of: see `alike`.

    Of a range, a device that cannot be asked is one that can be no tray.

    Raises:
        UserError: the address or the range is none, or its only device cannot be asked, or has no fans.
    """
    _require_no_password(option, url)
    try:
        urls = hosts_of(url)
    except ValueError as error:
        raise UserError(f"{option} {error}") from error
    if urls == [url]:
        return [discover(url)]

    def found(each: str) -> Found:
        try:
            return discover(each)
        except UserError as error:
            return Found("", each, {}, missing=(str(error).removeprefix(f"{each}: "),))

    with ThreadPoolExecutor(AT_ONCE) as pool:
        return list(alike(list(pool.map(found, urls)), host_of))


def _require_no_password(option: str, url: str) -> None:
    """Raise UserError, which does not show it, if a URL has a password."""
    if re.match(r"[^/@:]+:[^@]*@", url.partition("://")[2] or url):
        raise UserError(f"{option}: an address is shown, so no password in it: give USER@HOST and --password-file")


def alike(found: Sequence[Found], host_of: Callable[[Mapping[str, Any]], str]) -> Iterator[Found]:
    """One tray with `hosts` for all that differ in nothing else; the others as they are.

    host_of: host of a tray, which stands in its name, and in `url`, `host` and `labels` of its source.
    """
    groups: dict[str, list[Found]] = {}
    for each in found:
        if each.tray:
            groups.setdefault(json.dumps(_template(each.tray, host_of(each.tray))), []).append(each)
    taken: Counter[str] = Counter()
    for template, group in groups.items():
        if len(group) == 1:
            yield group[0]
            continue
        hosts = sorted((host_of(each.tray) for each in group), key=by_numbers)
        taken.update(hosts)
        number = max(taken[host] for host in hosts)
        name = {} if number == 1 else {"name": f"{{name}}-{number}"}
        title = f"{len(group)} devices, {hosts[0]} to {hosts[-1]}"
        notes = tuple(re.sub(r": .*", "", note) for note in group[0].notes)
        tray = {"hosts": ranges_of(hosts), **name, **json.loads(template)}
        yield Found(group[0].kind, title, tray, notes, group[0].missing)
    yield from (each for each in found if not each.tray)


def _template(tray: Mapping[str, Any], host: str) -> dict[str, Any]:
    def placed(value: Any) -> Any:
        return (
            {key: placed(each) for key, each in value.items()}
            if isinstance(value, dict)
            else (value.replace(host, "{host}") if isinstance(value, str) else value)
        )

    source = {key: placed(each) if key in ("url", "host", "labels") else each for key, each in tray["source"].items()}
    return {key: value for key, value in tray.items() if key != "name"} | {"source": source}


def free_name(wanted: str, names: set[str]) -> str:
    """A name of a tray that none of `names` is, which it joins; as near to the wanted one as the rules allow."""
    base = re.sub(r"[^A-Za-z0-9_-]", "-", wanted) or "tray"
    name, number = base, 1
    while name in names:
        number += 1
        name = f"{base}-{number}"
    names.add(name)
    return name


def as_toml(value: object) -> str:
    """A value of a configuration as TOML writes it."""
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {as_toml(each)}' for key, each in value.items())} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(as_toml, value))}]"
    if isinstance(value, str) and '"' in value and "'" not in value and value.isprintable():
        return f"'{value}'"
    return json.dumps(value, ensure_ascii=False)  # texts, numbers and booleans are alike in both
