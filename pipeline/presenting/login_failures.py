"""Wrong passwords, counted: who guesses must wait."""

from __future__ import annotations

import ipaddress
import time
from collections import OrderedDict, deque
from collections.abc import Callable

FAILURES, FAILURES_WITHIN_S = 5, 180.0
"""so many wrong passwords for one name, or from one address: then nobody logs in so until the first is that old. That
leaves a hundred guesses an hour"""
MOST_COUNTED = 4096
_NETWORK_BITS = 64


class LoginFailures:
    """Used in the thread of one server only."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._failures: OrderedDict[str, deque[float]] = OrderedDict()

    def begin(self, name: str, address: str) -> float:
        """Somebody gives a password: it counts as wrong until `succeed`, so that guesses side by side are counted, too.

        Returns how long to wait first, s, if there were too many; then nothing is counted. 0: go on.
        """
        names, now_s = _names(name, address), self._now_s()
        waits = [
            FAILURES_WITHIN_S - (now_s - failures[0])
            for each in names
            if len(failures := self._failures.get(each, deque[float]())) == FAILURES
        ]
        if (wait_s := max(waits, default=0.0)) > 0:
            return wait_s
        for each in names:
            self._failures.setdefault(each, deque(maxlen=FAILURES)).append(now_s)
            self._failures.move_to_end(each)
        while len(self._failures) > MOST_COUNTED:
            self._failures.popitem(last=False)
        return 0.0

    def succeed(self, name: str, address: str) -> None:
        """The password was right. What else came from the address stays: it may be of who guesses other names."""
        of_name, of_address = _names(name, address)
        self._failures.pop(of_name, None)
        if failures := self._failures.get(of_address):
            failures.pop()


def _names(name: str, address: str) -> tuple[str, str]:
    return f"name {name}", f"address {network_of(address)}"


def network_of(address: str) -> str:
    """What is counted of an address: of IPv6 its network, as one host has as many addresses there as it likes."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(found, ipaddress.IPv4Address):
        return str(found)
    if found.ipv4_mapped is not None:
        return str(found.ipv4_mapped)
    return str(ipaddress.ip_network((int(found), _NETWORK_BITS), strict=False))
