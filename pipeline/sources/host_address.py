"""Addresses to listen on, and ranges of hosts."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable
from urllib.parse import urlsplit

MOST_HOSTS = 4096
_RANGE = re.compile(r"\[([0-9][0-9,-]*)\]")


def is_of_this_host_only(host: str) -> bool:
    """Return whether only this host can reach a server at that address."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def hosts_of(text: str) -> list[str]:
    """The hosts of a range: `bmc[01-03,7].hall` has four, and any other text one.

    Raises:
        ValueError: a range that runs backwards, or of more than MOST_HOSTS.
    """
    match = _RANGE.search(text)
    if match is None:
        return [text]
    found: list[str] = []
    for part in match[1].split(","):
        first, dash, last = part.partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise ValueError(f"{text}: no range; write [001-400] or [1-4,7]")
        low, high = int(first), int(last or first)
        if not 0 <= high - low < MOST_HOSTS:
            raise ValueError(f"{text}: a range from low to high, of at most {MOST_HOSTS:,} hosts")
        found += [f"{number:0{len(first)}}" for number in range(low, high + 1)]
    rests = hosts_of(text[match.end() :])
    if len(found) * len(rests) > MOST_HOSTS:
        raise ValueError(f"{text}: more than {MOST_HOSTS:,} hosts")
    return [f"{text[: match.start()]}{number}{rest}" for number in found for rest in rests]


def host_and_port(text: str, default_port: int) -> tuple[str, int]:
    """Host and port of `plc1`, `plc1:1502` or `[fe80::1]`.

    Raises:
        ValueError: it is no such address.
    """
    parts = urlsplit(f"//{text}")
    if not parts.hostname or parts.port == 0 or parts.netloc != text or set(text) & set("@ "):
        raise ValueError("no address")
    return parts.hostname, parts.port or default_port


def by_numbers(text: str) -> tuple[tuple[bool, int | str], ...]:
    """What sorts names as people do: fan2 before fan10."""
    return tuple((part.isdecimal(), int(part) if part.isdecimal() else part) for part in re.split(r"(\d+)", text))


def ranges_of(hosts: Iterable[str]) -> list[str]:
    """Hosts as ranges, which `hosts_of` takes apart again: those in a row that differ in one number, by 1."""
    runs: list[tuple[list[str], list[str], int]] = []
    for host in sorted(hosts, key=by_numbers):
        parts = re.split(r"(\d+)", host)
        first, last, place = runs[-1] if runs else ([], [], 0)
        other = [at for at, pair in enumerate(zip(last, parts, strict=False)) if pair[0] != pair[1]]
        at = other[0] if len(other) == 1 and len(last) == len(parts) else 0
        if at % 2 and place in (0, at) and parts[at] == f"{int(last[at]) + 1:0{len(first[at])}}":
            runs[-1] = first, parts, at
        else:
            runs.append((parts, parts, 0))
    return [
        "".join([*first[:at], f"[{first[at]}-{last[at]}]", *first[at + 1 :]] if at else first)
        for first, last, at in runs
    ]
