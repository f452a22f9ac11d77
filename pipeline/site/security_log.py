"""Who logs in, who is refused, and what fails unexpectedly: a line each on standard error, as JSON after `event:`."""

from __future__ import annotations

import ipaddress
import json
import os
import sys
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime

FAILURES, FAILURES_WITHIN_S = 5, 180.0
"""so many wrong passwords for one name, or from one address: then nobody logs in so until the first is that old. That
leaves a hundred guesses an hour"""
MOST_COUNTED, MOST_KNOWN = 4096, 1024
LONGEST_NAME = 64
_NETWORK_BITS = 64


class LoginFailures:
    """Counts wrong passwords: who guesses must wait. Used in the thread of one server only."""

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


MOST_LINES, WITHIN_S = 60, 60.0
"""of more in that time it is only said how many there were: whoever guesses passwords fills no disk"""
LONGEST_VALUE = 200


class SecurityLog:
    """Thread-safe."""

    def __init__(self, write: Callable[[str], None] | None = None, now_s: Callable[[], float] = time.monotonic) -> None:
        """write: takes a line; None: it goes to standard error, which the launcher reads."""
        self._write = write or _to_standard_error
        self._now_s = now_s
        self._lock = threading.Lock()
        self._began_s = now_s()
        self._lines = self._left_out = 0

    def add(self, event: str, **values: str) -> None:
        """Something has happened. What comes from elsewhere cannot end the line, or look like another one."""
        with self._lock:
            now_s = self._now_s()
            if now_s - self._began_s >= WITHIN_S:
                self._began_s, self._lines = now_s, 0
            self._lines += 1
            if self._lines > MOST_LINES:
                self._left_out += 1
                return
            left_out, self._left_out = self._left_out, 0
        found = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "what": event}
        found |= {name: value[:LONGEST_VALUE] for name, value in values.items()}
        if left_out:
            found["events_left_out_before"] = str(left_out)
        self._write(f"event: {json.dumps(found)}")


def _to_standard_error(line: str) -> None:
    with suppress(OSError):  # whoever reads it may have gone
        os.write(sys.stderr.fileno(), f"{line}\n".encode())
