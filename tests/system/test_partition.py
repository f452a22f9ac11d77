"""Acquisition and its router lose each other for longer than a lease: nothing is lost, and the alarm comes.

A fan has its fault while the link is cut. Afterwards the samples are fetched, judged as if nothing had happened, and
recorded.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.bus.router_link import LEASE_MS
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.codec import decode
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm, Grid, Raw
from fantwin.schemas.topics import tray_key
from tests.support.fantwin_command import as_typed
from tests.support.running_chain import SITE, STEP_NS, TRAY, Chain, RunningCommand, eventually
from tests.support.tcp_relay import TcpRelay

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

FAULTY = 2
BEFORE_S, FAULT = 5.0, f"inlet:fan={FAULTY},start=12,stop=14,size=2.5"
CUT_S = int(LEASE_MS) / 1000 + 6.0
"""the whole fault lies in it, also if the cut comes seven seconds after BEFORE_S on a busy machine"""
CLIENTS = ("bus.mode='client'", "twin_integrator.warm_up_s=2")
JUDGES = ["resampler", "twin_integrator", "scorer", "recorder"]


class Site:
    """The chain behind a router, and acquisition behind a relay, under a launcher of its own as on another host."""

    def __init__(self, folder: Path, endpoint: str) -> None:
        self.router = RunningCommand(["router", "--listen", endpoint])
        self.relay = TcpRelay(endpoint)
        self.judges = self._chain(folder / "judges", endpoint, JUDGES)
        self.source = self._chain(folder / "source", self.relay.endpoint, ["acquisition"])

    def close(self) -> None:
        self.judges.close()
        self.source.close()
        self.relay.close()
        self.router.kill()

    def _chain(self, folder: Path, endpoint: str, stages: list[str]) -> Chain:
        folder.mkdir()
        return Chain(folder, endpoint, *CLIENTS, stages=stages)


@pytest.fixture
def site(tmp_path: Path, endpoint: str) -> Iterator[Site]:
    with closing(Site(tmp_path, endpoint)) as site:
        yield site


def grids(site: Site) -> list[Grid]:
    messages = [entry.message for path in site.judges.recordings() for entry in read_recording(path, ("grid",))]
    return [message for message in messages if isinstance(message, Grid)]


def alarms(site: Site) -> list[Alarm]:
    messages = [entry.message for path in site.judges.recordings() for entry in read_recording(path, ("alarm",))]
    return [message for message in messages if isinstance(message, Alarm)]


def test_row_16_a_cut_that_hides_a_whole_fault_loses_nothing_and_no_alarm(site):
    judges = site.judges.start_up()
    with Bus(BusConfig(mode="client", endpoint=site.judges.endpoint), threading.Event()) as bus:
        watcher = SiteWatcher(bus, SITE)
        eventually(lambda: len(watcher.alive()) == len(JUDGES), "the stages that judge are at work")
        received_ns: list[int] = []
        bus.subscribe(
            tray_key(SITE, TRAY, "raw"), lambda _key, data: received_ns.extend(decode(Raw, data).host_receive_t_ns)
        )
        device = site.source.start_tray("--fault", FAULT)
        source = site.source.start_up()
        enough_ns = BEFORE_S * 1e9
        eventually(lambda: received_ns and received_ns[-1] - received_ns[0] > enough_ns, "the first seconds have come")
        site.relay.cut()
        threading.Event().wait(CUT_S)
        assert not [line for line in judges.lines if "ALARM" in line], "nobody has seen the fault"
        source.line_with(f"acquisition/{TRAY}: the connection to the bus is lost")
        site.relay.heal()
        source.line_with(f"acquisition/{TRAY}: at work again")
        judges.line_with(f"ALARM  {TRAY}  fan {FAULTY}")
        judges.line_with(f"cleared  {TRAY}  fan {FAULTY}")
    assert device.end() == 0
    sent = device.output()["samples_sent"]
    for up in (source, judges):
        assert up.end() == 0, up.lines[-10:]
        assert not any(up.output()["lost"].values())
    found = grids(site)
    times = np.concatenate([grid.t_ns for grid in found])
    assert np.array_equal(times, np.arange(times[0], times[-1] + 1, STEP_NS))
    valid = np.concatenate([grid.valid.all(axis=1) for grid in found])
    last = np.flatnonzero(valid)[-1]
    assert valid[:last].all(), "the samples came late, and were judged: the only gap is after the device has ended"
    assert last >= sent - 5
    transitions = [alarm.transition for alarm in alarms(site) if alarm.fan == FAULTY]
    assert (transitions[0], transitions[-1]) == (Transition.RAISED, Transition.CLEARED)
    assert transitions.count(Transition.RAISED) == 1
    verified = as_typed("replay", "--offline", "--verify", *site.judges.recordings())
    assert verified.returncode == 0, verified.stdout + verified.stderr
