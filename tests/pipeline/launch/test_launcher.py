"""`fantwin up`: all stages from one file, stopped in the order of the data flow, or not started at all."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.shards import Shard, StageProcess, process_list
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.launch.launcher import Launcher, Outcome, _Slot
from fantwin.pipeline.launch.processes import Child, Notices
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.timebase.host_clock import VARIABLE as CLOCK_VARIABLE
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.topics import alive_key
from tests.support.made_messages import health
from tests.support.running_chain import DEMO, SITE, Chain
from tests.support.site_certificates import SiteCertificates
from tests.support.stub_bus import StubBus


@pytest.fixture
def chain(tmp_path: Path, endpoint: str) -> Iterator[Chain]:
    chain = Chain(tmp_path, endpoint)
    try:
        yield chain
    finally:
        chain.close()


@pytest.fixture
def no_bus(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Where the launcher would connect to the bus, before it starts anything, ConnectionError is raised."""

    def connect(*_: object, **__: object) -> None:
        raise ConnectionError

    monkeypatch.setattr("fantwin.pipeline.launch.launcher.join_bus", connect)
    return connect


@pytest.mark.parametrize(
    ("settings", "fault"),
    [
        (["launcher.stages=['acquisition', 'resampler', 'recorder']", "tray.0.twin='none.onnx'"], ""),
        (["tray.0.twin='none.onnx'"], f"{DEMO}/none.onnx: cannot read the twin: No such file or directory; correct "),
        (["tray.0.fans=5"], f"{DEMO}/twin.onnx: a twin of 8 fans, [[tray]] says fans = 5: choose a twin that fits"),
        (
            ["launcher.stages=['scorer']", "launcher.without=['scorer']"],
            f"{DEMO}/demo.toml: launcher.stages and launcher.without leave no stage to run: correct them",
        ),
    ],
)
def test_what_cannot_be_used_is_refused_before_anything_starts_and_a_site_that_only_records_needs_no_twin(
    no_bus, settings, fault
):
    with pytest.raises(UserError if fault else ConnectionError, match=re.escape(fault)):
        Launcher(load_config(DEMO / "demo.toml", settings), (), no_bus).run(threading.Event())


def test_a_certificate_that_cannot_be_used_is_refused_before_anything_starts(tmp_path, endpoint, no_bus):
    certificates = SiteCertificates(tmp_path)
    certificates.issue("acquisition", "resampler", "recorder")
    certificates.issue("resampler", lifetime=timedelta(seconds=-1))
    security = f'folder = "{certificates.folder}"\n'
    file = tmp_path / "fantwin.toml"
    stages = ["acquisition", "resampler", "recorder"]
    bus = f'[bus]\nmode = "client"\nendpoint = "{endpoint.replace("tcp/", "tls/")}"\n[bus.security]\n{security}'
    file.write_text(f'{bus}[launcher]\nstages = {stages}\n[[tray]]\nname = "a"\nfans = 2\nport = "/dev/none"\n')
    with pytest.raises(UserError, match=r"resampler\.pem: expired on "):
        Launcher(load_config(file), (), no_bus).run(threading.Event())
    certificates.issue("resampler")
    with pytest.raises(ConnectionError):
        Launcher(load_config(file), (), no_bus).run(threading.Event())


@pytest.mark.parametrize("stages", [["acquisition", "scorer"], ["scorer"]])
def test_without_a_learner_a_tray_needs_a_twin_where_its_device_is_read_and_not_beside_a_replay(
    tmp_path, no_bus, stages
):
    file = tmp_path / "fantwin.toml"
    file.write_text(f'[launcher]\nstages = {stages}\n[[tray]]\nname = "a"\nfans = 2\nport = "/dev/none"\n')
    error, why = (UserError, "tray a has no twin") if "acquisition" in stages else (ConnectionError, "")
    with pytest.raises(error, match=why):
        Launcher(load_config(file), (), no_bus).run(threading.Event())


@pytest.mark.slow
def test_row_18_stopped_before_all_are_ready_no_source_is_started_and_no_stage_has_failed(chain):
    """Sources start last: before that no stage could receive their samples. A stage that is still starting does not
    catch SIGTERM yet and ends by it."""
    stop = threading.Event()
    lines: list[str] = []

    def say(line: str) -> None:
        lines.append(line)
        if line.startswith("resampler: started"):
            stop.set()

    outcome = Launcher(load_config(DEMO / "demo.toml", chain.settings), chain.settings, say).run(stop)
    assert (outcome.killed, outcome.failed, outcome.exit_code) == ([], [], 0)
    assert not [line for line in lines if "ended with status" in line]
    started = [line.split(":")[0] for line in lines if ": started" in line]
    assert started == ["recorder", "scorer", "twin_integrator", "resampler"]


class LateBus:
    """A bus that discovers a stage of `site` `after_s` seconds late. Its clock advances while it is waited for."""

    def __init__(self, site: str, after_s: float, *, came_second: bool = True, stage: str = "scorer") -> None:
        self._stage = stage
        self.came_second = came_second
        self.now_s = 100.0
        self._discovered_s = 100.0 + after_s
        self._site = site

    def monotonic(self) -> float:
        return self.now_s

    def wait(self, seconds: float) -> bool:
        """Behaves as an event that is never set."""
        self.now_s += seconds
        return False

    sleep = wait

    def wait_for_others(self, _stop: object) -> None:
        """One has been met."""

    def certificate_warning(self) -> str:
        return ""

    def alive(self, _key: str) -> set[str]:
        return {alive_key(self._site, self._stage, "all")} if self.now_s >= self._discovered_s else set()


def search_time_s(bus: Any, monkeypatch: pytest.MonkeyPatch, *settings: str) -> float:
    """How long the launcher searched for another one in vain."""
    monkeypatch.setattr("fantwin.pipeline.launch.launcher.time", bus)
    config = load_config(DEMO / "demo.toml", settings)
    Launcher(config, (), lambda _line: None)._refuse_second_launcher(bus, bus)
    return bus.now_s - 100.0


def test_a_second_launcher_searches_for_stages_of_its_site_for_two_seconds_and_the_first_does_not(monkeypatch):
    with pytest.raises(UserError, match=r"site 'demo' already runs at \S+ \(scorer\): stop that"):
        search_time_s(LateBus(SITE, after_s=1.5), monkeypatch)
    assert search_time_s(LateBus(SITE, after_s=99.0), monkeypatch) == pytest.approx(2.0, abs=0.1)
    assert search_time_s(LateBus("other", after_s=0.0), monkeypatch, "bus.mode='client'") == pytest.approx(2.0, abs=0.1)
    assert search_time_s(LateBus(SITE, after_s=1.0, came_second=False), monkeypatch) == 0.0
    stopped = LateBus("other", after_s=5.0)
    monkeypatch.setattr(stopped, "wait", lambda _seconds: True)
    assert search_time_s(stopped, monkeypatch) == 0.0


def test_row_07_a_launcher_is_refused_where_a_replay_presents_its_site_unless_it_starts_no_device(monkeypatch):
    with pytest.raises(UserError, match=r"^a replay presents site 'demo' at \S+: stop it, leave acquisition out of "):
        search_time_s(LateBus(SITE, after_s=1.5, stage="replay"), monkeypatch)
    without_device = "launcher.stages=['scorer', 'viewer']"
    searched_s = search_time_s(LateBus(SITE, after_s=1.5, stage="replay"), monkeypatch, without_device)
    assert searched_s == pytest.approx(2.0, abs=0.1)


class NoRoom:
    """A system that can start no process until `has_room`."""

    def __init__(self) -> None:
        self.has_room = False

    def __call__(self, *_arguments: object) -> Any:
        if not self.has_room:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        return EndedChild()


@pytest.fixture
def no_room(monkeypatch: pytest.MonkeyPatch) -> NoRoom:
    no_room = NoRoom()
    monkeypatch.setattr("fantwin.pipeline.launch.launcher.Child", no_room)
    monkeypatch.setattr(Launcher, "_is_back", lambda *_: True)
    return no_room


def recorder_only(lines: list[str], monkeypatch: pytest.MonkeyPatch) -> tuple[Launcher, Any, Any]:
    """A launcher of one stage, its clock, and its only slot."""
    bus: Any = LateBus(SITE, 0.0)
    monkeypatch.setattr("fantwin.pipeline.launch.launcher.time", bus)
    monkeypatch.setattr("fantwin.pipeline.launch.launcher.RESTART_DELAY_MAX_S", 3.0)
    launcher = Launcher(load_config(DEMO / "demo.toml", ["launcher.stages=['recorder']"]), (), lines.append)
    launcher._watcher = SiteWatcher(cast("Any", StubBus()), SITE)
    (slot,) = launcher._slots
    slot.delay_s = 1.0
    return launcher, bus, slot


def test_a_stage_for_which_there_is_no_process_is_started_later_unless_the_site_begins_or_ends(monkeypatch, no_room):
    lines: list[str] = []
    launcher, clock, slot = recorder_only(lines, monkeypatch)
    why = "recorder: no process could be started: Resource temporarily unavailable"
    with pytest.raises(UserError, match=f"^{why}; free "):
        launcher._start_all(threading.Event())
    slot.start_at_s = clock.now_s
    for _ in range(5):
        launcher._check_processes()
        clock.now_s += 1.0
    launcher._restart_those_down()
    assert launcher.outcome.failed == ["recorder"]
    no_room.has_room = True
    clock.now_s += 3.0
    launcher._check_processes()
    again = [f"{why}; trying again in {delay_s} s" for delay_s in (1.0, 2.0, 3.0)]
    lost = f"{why}; what it missed while it was down is lost"
    assert lines == [*again, lost, "recorder: started, process 7"]
    assert slot.sessions == [("recorder", 7)]


def test_a_stage_that_was_restarted_just_before_the_end_is_waited_for(monkeypatch, no_room):
    launcher, clock, slot = recorder_only([], monkeypatch)
    no_room.has_room, slot.was_ready = True, True
    launcher._start(slot)
    monkeypatch.setattr(EndedChild, "exit_status", lambda _child: None)
    monkeypatch.setattr(launcher, "_is_back", lambda _slot: clock.now_s > 104.0)
    launcher._restart_those_down()
    assert 104.0 < clock.now_s < 105.0


class EndedChild:
    """The process of a stage that ends in order. called: what is asked of it, with its name."""

    process_id, heard_s, is_ready = 7, float("inf"), True
    last_line = ""

    def __init__(self, name: str = "", called: list[str] | None = None) -> None:
        self.name, self.called = name, [] if called is None else called

    def exit_status(self) -> int:
        return 0

    def terminate(self) -> None:
        self.called.append(f"asked {self.name}")

    def stop(self, _timeout_s: float) -> int:
        self.called.append(f"ended {self.name}")
        return 0


def test_the_processes_of_a_stage_end_together_and_before_those_of_the_next(monkeypatch):
    called: list[str] = []
    launcher = Launcher(load_config(DEMO / "demo.toml"), (), lambda _line: None)
    monkeypatch.setattr(launcher, "_has_reported", lambda _slot: True)
    shards = [Shard(f"{n}-of-2", ("tray1",), ("--shard", f"{n}/2")) for n in (1, 2)]
    rows = [StageProcess(stage, shard) for stage in ("resampler", "scorer") for shard in shards]
    launcher._slots = [_Slot(row, cast("Any", EndedChild(row.label, called))) for row in rows]
    launcher._stop_all()
    in_order = [(word, stage) for stage in ("resampler", "scorer") for word in ("asked", "ended")]
    assert called == [f"{word} {stage}/{n}-of-2" for word, stage in in_order for n in (1, 2)]


class Heard:
    """A watcher that hears these healths of one session, one after the other."""

    def __init__(self, *statuses: StageStatus) -> None:
        self.statuses = list(statuses)

    def last_health(self, _session: object) -> Any:
        if len(self.statuses) > 1:
            del self.statuses[0]
        return health("recorder", status=self.statuses[0], process_id=7) if self.statuses else None


def stopped(watcher: Any, monkeypatch: pytest.MonkeyPatch, *, was_ready: bool = True) -> tuple[Outcome, list[str]]:
    """How a run ends whose only stage was the recorder."""
    lines: list[str] = []
    launcher, _, slot = recorder_only(lines, monkeypatch)
    slot.child, slot.was_ready, slot.sessions = cast("Any", EndedChild()), was_ready, [("recorder", 7)]
    launcher._watcher, launcher._is_started = watcher, True
    launcher._stop_all()
    return launcher.outcome, lines


UNKNOWN = ["recorder: its last health message did not arrive: what it lost is unknown"]


@pytest.mark.parametrize(
    ("heard", "was_ready", "said"),
    [
        pytest.param([StageStatus.OK], True, UNKNOWN, id="not its last"),
        pytest.param([], True, UNKNOWN, id="not the one started at the end"),
        pytest.param([*[StageStatus.OK] * 3, StageStatus.STOPPED], True, [], id="its last, after its end"),
        pytest.param([], False, ["recorder: was never ready: it has received nothing"], id="none, never ready"),
    ],
)
def test_row_18_a_stage_has_ended_in_order_if_it_was_ready_and_its_last_health_is_heard(
    heard, was_ready, said, monkeypatch
):
    outcome, lines = stopped(Heard(*heard), monkeypatch, was_ready=was_ready)
    assert (outcome.exit_code, lines) == (1 if said else 0, said)


@pytest.mark.parametrize(
    ("files", "recorded"),
    [
        ((), "nothing"),
        (("recording-3.mcap", "recording-4.mcap.active"), "recording-3.mcap to {}recording-4.mcap, 2 parts"),
    ],
)
def test_it_says_which_files_a_run_recorded_also_one_that_failed(tmp_path, monkeypatch, files, recorded):
    for name in ("recording.mcap", "recording-2.mcap.active"):  # the latter was left by a killed recorder
        (tmp_path / name).touch()
    monkeypatch.setattr(
        "fantwin.pipeline.launch.launcher.join_bus", lambda *_, **__: nullcontext(LateBus("elsewhere", 0.0))
    )
    heard_nothing = SimpleNamespace(stages=list, losses=lambda *_: {}, refused=dict, unusable=lambda _: [])
    monkeypatch.setattr("fantwin.pipeline.launch.launcher.SiteWatcher", lambda *_: heard_nothing)
    settings = [f"run_folder='{tmp_path}'", "launcher.stages=['recorder']"]
    launcher = Launcher(load_config(DEMO / "demo.toml", settings), (), lambda _line: None)

    def fail(_stop: object) -> None:
        (tmp_path / "recording-2.mcap.active").rename(tmp_path / "recording-2.mcap")
        for name in files:
            (tmp_path / name).touch()
        raise UserError("a stage cannot start")

    monkeypatch.setattr(launcher, "_refuse_second_launcher", lambda *_: None)
    monkeypatch.setattr(launcher, "_start_all", fail)
    with pytest.raises(UserError, match="a stage cannot start"):
        launcher.run(threading.Event())
    assert launcher.outcome.recorded == (f"{tmp_path}/{recorded.format(f'{tmp_path}/')}" if files else recorded)


def test_a_service_manager_hears_that_the_site_has_started_and_that_its_launcher_is_at_work(tmp_path, monkeypatch):
    notices, stop = Notices(), threading.Event()
    monkeypatch.setenv("NOTIFY_SOCKET", notices.address)
    here = LateBus("elsewhere", 0.0)
    monkeypatch.setattr("fantwin.pipeline.launch.launcher.join_bus", lambda *_, **__: nullcontext(here))
    heard_nothing = SimpleNamespace(stages=list, losses=lambda *_: {}, refused=dict, unusable=lambda _: [])
    monkeypatch.setattr("fantwin.pipeline.launch.launcher.SiteWatcher", lambda *_: heard_nothing)
    settings = [f"run_folder='{tmp_path}'", "launcher.stages=['recorder']"]
    launcher = Launcher(load_config(DEMO / "demo.toml", settings), (), lambda _line: None)
    said: list[tuple[bool, bool]] = []

    def start(_stop: object) -> None:
        said.append((notices.read(), notices.is_ready))

    for name in ("_refuse_second_launcher", "_report_changes", "_restart_those_down", "_stop_all"):
        monkeypatch.setattr(launcher, name, lambda *_: None)
    monkeypatch.setattr(launcher, "_start_all", start)
    monkeypatch.setattr(launcher, "_check_processes", stop.set)
    launcher.run(stop)
    assert said == [(False, False)], "not before all stages have started"
    assert (notices.read(), notices.is_ready, notices.status) == (True, True, "site demo: 1 processes")
    notices.close()


@pytest.mark.parametrize(
    ("outcome", "code"),
    [
        (Outcome(), 0),
        (Outcome(restarts={"scorer": 1}, lost={"scorer": 0}), 0),
        (Outcome(lost={"scorer": 0, "resampler": 4}), 3),
        (Outcome(killed=["viewer"], lost={"resampler": 4}), 1),
        (Outcome(lost={"acquisition/bench": 4}, unusable=["acquisition/bench: ..."]), 1),
        (Outcome(refused={"acquisition/bench": {"refused_input": 30}}), 0),
    ],
)
def test_the_exit_code_says_whether_anything_was_lost_or_a_device_is_unusable(outcome, code):
    assert outcome.exit_code == code


def test_row_13_a_stage_goes_on_with_the_time_of_its_launcher_when_it_is_started_again(tmp_path, monkeypatch):
    class StartedError(Exception):
        """Instead of a process."""

    def start(_command: list[str], *, env: dict[str, str], **_more: object) -> None:
        raise StartedError(env[CLOCK_VARIABLE])

    config = load_config(DEMO / "demo.toml")
    monkeypatch.setattr(subprocess, "Popen", start)
    with pytest.raises(StartedError, match="12345"):
        Child(process_list(config)[0], config.path, (), lambda _row, _line: None, 12345)
