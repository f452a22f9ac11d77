"""A site with certificates, from nothing to an alarm: authority, certificates, router, stages, operator, recovery.

A stage is killed on the way: what it missed is asked of its producers, whose answers the router must let through.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from fantwin.pipeline.bus.session import join_bus
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.site.site_watcher import SiteWatcher
from tests.support.fantwin_command import as_typed
from tests.support.running_chain import DEADLINE_S, DEMO, TRAY, Chain, eventually, received, view_of

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

FAULTY = 2


@pytest.fixture
def chain(tmp_path: Path, endpoint: str, new_chain: Callable[..., Chain]) -> Chain:
    settings = ["bus.mode=client", f"bus.security.folder='{tmp_path}/certs'", "twin_integrator.warm_up_s=2"]
    return new_chain(*settings, endpoint=endpoint.replace("tcp/", "tls/"))


def test_a_site_with_certificates_comes_from_nothing_to_an_alarm(chain, start_command):
    authority = ("--authority", chain.folder / "authority")
    for words in (["init", *authority], ["issue", *authority]):
        done = as_typed(*chain.words("certs"), *words)
        assert done.returncode == 0, done.stderr
    start_command(*chain.words("router"))
    run(chain)


def run(chain: Chain) -> None:
    settings = [word for setting in chain.settings for word in ("--set", setting)]
    config = load_config(DEMO / "demo.toml", settings[1::2], stages=())
    chain.start_tray("--profile", "manual", "--fault", f"inlet:fan={FAULTY},start=12,size=2.5")
    up = chain.start_up()
    with join_bus(config, threading.Event(), listens=False) as bus:
        watcher = SiteWatcher(bus, config.site, trays=config.trays)
        eventually(lambda: received(view_of(watcher, "recorder")) > 50, "the recorder has messages")
        chain.kill(watcher, "scorer")
        (alarm,) = eventually(watcher.current_alarms, "an alarm stands")
        assert (alarm.newest.header.tray, alarm.newest.fan) == (TRAY, FAULTY)
        acknowledged = as_typed(*chain.words("alarms"), "acknowledge", TRAY, FAULTY, "--timeout", DEADLINE_S)
        assert acknowledged.returncode == 0, acknowledged.stderr
        assert not any(view.health.problem for view in watcher.stages() if "certificate" in view.health.problem)
    doctor = as_typed(*chain.words("doctor"), "--listen-s", 0, "--json")
    good = json.loads(doctor.stdout)["good"]
    assert "certificate of scorer: the router grants its rights" in good
    assert up.end() == 0, up.lines
    lost = up.output()["lost"]
    assert not any(lost.values()), (lost, up.lines)
