"""Wrong passwords, counted: who guesses must wait."""

from __future__ import annotations

import ipaddress
import time
from collections import OrderedDict, deque
from collections.abc import Callable

FAILURES, FAILURES_WITHIN_S = 5, 180.0
"""so many wrong passwords for one name, or from one address: then nobody logs in so until the first is that old. That
leaves a hundred guesses an hour"""
MOST_COUNTED, MOST_KNOWN = 4096, 1024
LONGEST_NAME = 64
_NETWORK_BITS = 64


class LoginFailures:
    """Used in the thread of one server only."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._failures: OrderedDict[str, deque[float]] = OrderedDict()
        self._known: OrderedDict[tuple[str, str], None] = OrderedDict()
        """names and the networks from which they have logged in: guesses from elsewhere do not lock them out there"""

    def begin(self, name: str, address: str) -> float:
        """Somebody gives a password: it counts as wrong until `succeed`, so that guesses side by side are counted, too.

        Returns how long to wait first, s, if there were too many; then nothing is counted. 0: go on.
        """
        names, now_s = self._counted(name, address), self._now_s()
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
        of_name, of_address = self._counted(name, address)
        self._failures.pop(of_name, None)
        if failures := self._failures.get(of_address):
            failures.pop()
        known = (name[:LONGEST_NAME], network_of(address))
        self._known[known] = None
        self._known.move_to_end(known)
        while len(self._known) > MOST_KNOWN:
            self._known.popitem(last=False)

    def _counted(self, name: str, address: str) -> tuple[str, str]:
        network, name = network_of(address), name[:LONGEST_NAME]
        is_known = (name, network) in self._known
        return f"name {name} at {network}" if is_known else f"name {name}", f"address {network}"


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
