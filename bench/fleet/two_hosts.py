"""Two hosts with two shards of the scorer each: one is cut off for a while, and later vanishes.

The hosts are network namespaces on a bridge, with a router, the other stages and the feed on a third. First a scorer is
killed; then the second host is cut off for longer than a lease; in the end it vanishes with all its processes and
files, and its shards are started on the first host, in an empty run folder. What was recorded is compared with what was
sent, and with what the same samples give where nothing happens. Linux, root.

    python -m bench.fleet.two_hosts
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from bench.fleet.fed_outcome import RECORDS_SCORES, Outcome, outcome_of
from bench.fleet.fed_trays import BUSY, SITE, Feed, Load, NewestScores
from bench.fleet.network_hosts import ALONE, Host, Process, bridge
from bench.printing import JsonOption, progress, show
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.messages import Raw

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.support.running_chain import eventually

ROUTER = "10.77.0.1"
ENDPOINT = f"tcp/{ROUTER}:7447"
SHARDS = {"resampler": 1, "twin_integrator": 1, "scorer": 4, "recorder": 2}
ON_HOSTS = ["scorer"]
CUT_S = 8.0
"""longer than a lease, after which the router takes a silent client for gone"""
DEADLINE_S = 900.0  # far beyond what anything takes


def main(
    seconds: Annotated[float, typer.Option(help="Of samples; a quarter of them before each event.")] = 120.0,
    json_output: JsonOption = False,
    inside: Annotated[bool, typer.Option(hidden=True)] = False,
) -> None:
    """Print what was lost and which alarms differ; exit code 1 if something was lost and not counted, or one does."""
    if not inside:
        words = [sys.executable, "-m", "bench.fleet.two_hosts", "--inside", "--seconds", str(seconds)]
        os.execvp(ALONE[0], [*ALONE, *words, *(["--json"] if json_output else [])])
    with tempfile.TemporaryDirectory() as folder:
        found = run(Load(SHARDS["scorer"], seconds), Path(folder), progress)
    show({"two hosts": [found.row()]}, found.notes(), as_json=json_output)
    if found.lost_silently or not found.alarms_are_right:
        raise typer.Exit(1)


def run(load: Load, folder: Path, say: Callable[[str], None]) -> Outcome:
    """The outcome. It must run in a network namespace of its own. folder: for configuration and recordings."""
    say("simulating")
    sent = load.made_beforehand()
    shards = ", ".join(f"{stage} = {number}" for stage, number in SHARDS.items())
    (folder / "site.toml").write_text(
        f'site = "{SITE}"\n[launcher]\nshards = {{ {shards} }}\n{BUSY}'
        f'[bus]\nmode = "client"\nendpoint = "{ENDPOINT}"\n{RECORDS_SCORES}{load.tables}'
    )
    bridge(ROUTER)
    site = _Site(folder)
    try:
        site.feed(load, sent, say)
        lost = site.end()
    finally:
        site.close()
    say("comparing with what should have been decided")
    return outcome_of([folder / "recorder"], sent, lost, may_move_s=0.0)


class _Site:
    """The processes, and what happens to them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._hosts = [Host("one", "10.77.0.11"), Host("two", "10.77.0.12")]
        self._router = Process(["router", "--listen", ENDPOINT, "--insecure"], folder / "router")
        self._first = self._up("first", ["resampler", "twin_integrator"])
        self._recorder = self._up("recorder", ["recorder"])
        self._ups = [self._up(host.name, ON_HOSTS, n, host) for n, host in enumerate(self._hosts, 1)]
        self._bus = Bus(BusConfig(mode="client", endpoint=ENDPOINT), threading.Event())
        self._watcher = SiteWatcher(self._bus, SITE)

    def feed(self, load: Load, sent: dict[str, list[Raw]], say: Callable[[str], None]) -> None:
        """Feed it, and let things happen meanwhile; wait until everything is scored."""
        with Feed(self._bus, load, sent) as feed:
            self._let_things_happen(load, sent, feed, say)

    def _let_things_happen(
        self, load: Load, sent: dict[str, list[Raw]], feed: Feed, say: Callable[[str], None]
    ) -> None:
        one, two = self._hosts
        ends = NewestScores(self._bus)
        self._wait_for_all()
        say("feeding the beginning")
        feed.begin()
        eventually(lambda: ends.have_reached(load, sent, load.beginning_s), "that is scored", DEADLINE_S)
        feeding = threading.Thread(target=feed.run)
        feeding.start()
        time.sleep(load.seconds / 4)
        scorer = next(view for view in self._watcher.stages() if view.health.stage == "scorer")
        say(f"killing scorer/{scorer.health.instance}")
        os.kill(scorer.health.process_id, signal.SIGKILL)
        time.sleep(load.seconds / 4)
        say("cutting off the second host")
        two.cut()
        time.sleep(CUT_S)
        two.heal()
        self._wait_for_all()
        time.sleep(max(0.0, load.seconds / 4 - CUT_S))
        say("the second host vanishes")
        two.vanish()
        self._ups.pop().kill()
        self._take_over(load, one)
        feeding.join()
        say("waiting until all is scored")
        end_s = load.beginning_s + load.seconds
        eventually(lambda: ends.have_reached(load, sent, end_s), "the last samples are scored", DEADLINE_S)

    def end(self) -> dict[str, int]:
        """Stop it in the order of the data flow; what each process has lost."""
        found: dict[str, int] = {}
        for up in (self._first, *self._ups, self._recorder):
            for name, lost in up.end(DEADLINE_S)["lost"].items():
                found[name] = found.get(name, 0) + lost
        return found

    def close(self) -> None:
        """Leave nothing."""
        self._bus.close()
        for process in (self._first, *self._ups, self._recorder, self._router):
            process.kill()
        for host in self._hosts:
            host.kill()

    def _up(self, name: str, stages: list[str], number: int = 0, host: Host | None = None) -> Process:
        """`fantwin up` of some stages; number: of the host among those that share the trays."""
        words = [
            "up",
            "-c",
            self._folder / "site.toml",
            "--insecure",
            "--json",
            *(("--shard", f"{number}/2") if number else ()),
        ]
        words += ["--set", f"launcher.stages={json.dumps(stages)}", "--set", f"run_folder='{self._folder / name}'"]
        return Process(words, self._folder / name, host)

    def _take_over(self, load: Load, host: Host) -> None:
        """Start the shards of the second host on another one, as a service manager would: again, until it is let."""
        until_s = time.monotonic() + DEADLINE_S
        while not self._has_all(load, host):
            assert time.monotonic() < until_s, "the shards of the second host are not started"
            if len(self._ups) == 1 or self._ups[1].process.poll() is not None:
                self._ups[1:] = [self._up("one-for-two", ON_HOSTS, 2, host)]
            time.sleep(0.2)

    def _has_all(self, load: Load, host: Host) -> bool:
        owners = [self._watcher.owner(stage, tray) for stage in ON_HOSTS for tray in load.names]
        return self._are_all_at_work() and all(owner is not None and owner.host == host.name for owner in owners)

    def _wait_for_all(self) -> None:
        eventually(self._are_all_at_work, "all processes are at work", DEADLINE_S)

    def _are_all_at_work(self) -> bool:
        return len(self._watcher.alive()) == sum(SHARDS.values())


if __name__ == "__main__":
    typer.run(main)
