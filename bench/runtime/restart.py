"""How long after kill -9 a stage works again, and what that costs: seconds for each stage, median of three.

Printed too is the ratio to the two seconds that are allowed. A stage is back when its new process shows its liveliness
token and reads its inputs; the time is that from the kill until a watcher elsewhere on the bus has seen it.
"""

from __future__ import annotations

import socket
import statistics
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.support.running_chain import STAGES, Chain, eventually, published, view_of

ALLOWED_S = 2.0
REPEATS = 3


def main() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with tempfile.TemporaryDirectory() as folder:
        chain = Chain(Path(folder), endpoint, stages=(*STAGES, "viewer"))
        try:
            measure(chain)
        finally:
            chain.close()


def measure(chain: Chain) -> None:
    chain.start_tray()
    up = chain.start_up()
    with chain.watcher() as watcher:
        eventually(lambda: published(view_of(watcher, "scorer")) > 100, "scores flow")
        for label in chain.stages:
            took_s = []
            for _ in range(REPEATS):
                took_s.append(chain.kill(watcher, label))
                scored = published(view_of(watcher, "scorer"))
                eventually(lambda: published(view_of(watcher, "scorer")) > scored + 50, "scores flow")  # noqa: B023
            median_s, worst_s = statistics.median(took_s), max(took_s)
            print(f"{label:20} {median_s:5.2f} s, worst {worst_s:.2f} s: {worst_s / ALLOWED_S:.2f} of the allowed")
    assert chain.tray
    chain.tray.end()
    sent = chain.tray.output()
    up.end()
    lost = sum(up.output()["lost"].values())
    share = lost / (sent["samples_sent"] + sent["samples_unsent"])
    print(
        f"{lost} samples lost, {share:.3%} of all, in {REPEATS} deaths of acquisition, {sent['samples_unsent']} of them"
    )
    print("  before they left the tray, which had no reader")


if __name__ == "__main__":
    main()
