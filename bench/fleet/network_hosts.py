"""Hosts on one machine: network namespaces on a bridge.

The caller must be root, and run behind ALONE: in namespaces of its own for network and processes, so that nothing
outlives it and nothing outside is changed.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ALONE = ("unshare", "--net", "--pid", "--fork", "--kill-child", "--mount-proc")
"""the words before a command that makes hosts"""
_BRIDGE = "fantwin0"


def bridge(address: str) -> None:
    """Make the network, and this process a part of it."""
    _ip("link set lo up")
    _ip(f"link add {_BRIDGE} type bridge")
    _ip(f"addr add {address}/24 dev {_BRIDGE}")
    _ip(f"link set {_BRIDGE} up")


class Host:
    """A host with an address."""

    def __init__(self, name: str, address: str) -> None:
        self.name = name
        first = f"hostname {name} && echo there && exec sleep infinity"
        self._first = subprocess.Popen(
            ["unshare", "--net", "--uts", "sh", "-c", first], stdout=subprocess.PIPE, text=True
        )
        assert self._first.stdout
        assert self._first.stdout.readline() == "there\n"
        self._network = Path(f"/proc/{self._first.pid}/ns/net").readlink()
        _ip(f"link add {name} type veth peer name eth0 netns {self._first.pid}")
        _ip(f"link set {name} master {_BRIDGE} up")
        for words in ("link set lo up", f"addr add {address}/24 dev eth0", "link set eth0 up"):
            subprocess.run([*self.inside, "ip", *words.split()], check=True)

    @property
    def inside(self) -> list[str]:
        """The words before a command that runs on this host."""
        return ["nsenter", "-t", str(self._first.pid), "--net", "--uts"]

    def cut(self) -> None:
        """Take it off the network."""
        _ip(f"link set {self.name} down")

    def heal(self) -> None:
        """Connect it again."""
        _ip(f"link set {self.name} up")

    def vanish(self) -> None:
        """Cut it off and kill all of its processes: no connection is closed."""
        self.cut()
        self.kill()

    def kill(self) -> None:
        """Kill all of its processes; it is there no more."""
        for process_id in self._processes():
            os.kill(process_id, signal.SIGKILL)
        self._first.wait()
        subprocess.run(["ip", "link", "del", self.name], check=False, stderr=subprocess.DEVNULL)  # or it goes by itself

    def _processes(self) -> list[int]:
        found: list[int] = []
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                if (folder / "ns" / "net").readlink() == self._network:
                    found.append(int(folder.name))
            except OSError:  # it has ended
                continue
        return found


class Process:
    """A `fantwin` command on a host, or here, with what it prints in two files."""

    def __init__(self, words: Iterable[object], log: Path, host: Host | None = None) -> None:
        """log: the name of the files, without suffix."""
        self._output = log.with_suffix(".json")
        self._log = log.with_suffix(".log")
        with self._output.open("wb") as output, self._log.open("ab") as errors:
            self.process = subprocess.Popen(
                [*(host.inside if host else ()), sys.executable, "-P", "-m", "fantwin", *map(str, words)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=errors,
                start_new_session=True,
            )

    def end(self, limit_s: float) -> Any:
        """Stop it in order and return the JSON that it has printed.

        Raises:
            AssertionError: it did not end in order.
        """
        self.process.send_signal(signal.SIGINT)
        status = self.process.wait(limit_s)
        assert status in (0, 3), (status, self.last_lines())
        return json.loads(self._output.read_text())

    def last_lines(self) -> Sequence[str]:
        """The last lines of what it has said."""
        return self._log.read_text().splitlines()[-20:]

    def kill(self) -> None:
        """End it at once, if it runs."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


def _ip(words: str) -> None:
    subprocess.run(["ip", *words.split()], check=True)
