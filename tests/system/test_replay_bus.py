"""`fantwin replay` on a bus: real stages in processes take all of it, at any rate, and decide as if it were today."""

from __future__ import annotations

import json
import os
import pty
import queue
import signal
import subprocess
import termios
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.codec import decode
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Clock, Grid, Message, Raw
from fantwin.schemas.topics import health_key, tray_key
from fantwin.stages.resampler import ResamplerConfig, ResamplerCore
from tests.support.fantwin_command import as_typed
from tests.support.killed_site import Site as RecordedSite
from tests.support.replay_data import START_NS, STEP_NS, write_raw
from tests.support.running_chain import (
    DEADLINE_S,
    FANTWIN,
    SITE,
    TRAY,
    Chain,
    RunningCommand,
    eventually,
    fantwin,
    view_of,
)
from tests.support.twin_files import small_hybrid, write_twin

pytestmark = pytest.mark.real_time
WORKING = ["resampler", "twin_integrator", "scorer", "recorder"]
SILENCE = "resampler.watermark_s=0.5"
"""as by default: a replay is silent by its own clock, on any machine"""


class Site:
    """Stages of the site of the demo, and the messages received on their bus."""

    def __init__(self, folder: Path, endpoint: str, *, listens: bool = True) -> None:
        self.chain = Chain(folder, endpoint, SILENCE, "resampler.rate_hz=100")
        self.heard: dict[type[Message], queue.Queue[Message]] = {kind: queue.Queue() for kind in (Grid, Clock, Health)}
        self.bus = Bus(BusConfig(endpoint=endpoint), listens=listens)
        self.watcher = SiteWatcher(self.bus, SITE)
        self.running: list[RunningCommand] = []
        for topic, kind in (("grid", Grid), ("clock", Clock)):
            self.bus.subscribe(tray_key(SITE, TRAY, topic), lambda _key, data, kind=kind: self.hear(kind, data))
        self.bus.subscribe(health_key(SITE, "replay", "all"), lambda _key, data: self.hear(Health, data))

    def hear(self, kind: type[Message], data: bytes) -> None:
        self.heard[kind].put(decode(kind, data))

    def start(self, label: str) -> RunningCommand:
        running = RunningCommand(
            ["up", "--only", label.split("/", maxsplit=1)[0], *self.chain.words("run")[1:], "--json"]
        )
        self.running.append(running)

        def is_there() -> bool:
            assert running.process.poll() is None, running.lines
            view = view_of(self.watcher, label)
            return view is not None and view.alive

        eventually(is_there, f"{label} is there")
        return running

    def words(self, *words: object) -> list[object]:
        return ["replay", *words, *self.chain.words("")[1:]]

    def replay(self, *words: object) -> subprocess.CompletedProcess[str]:
        return as_typed(*self.words(*words))

    def next(self, kind: type[Message]) -> Any:
        return self.heard[kind].get(timeout=DEADLINE_S)

    def grids_until(self, t_ns: int) -> list[Grid]:
        grids = [self.next(Grid)]
        while grids[-1].t_ns[-1] < t_ns:
            grids.append(self.next(Grid))
        return grids

    def close(self) -> None:
        self.bus.close()
        for running in self.running:
            running.kill()
        self.chain.close()


@pytest.fixture
def listens() -> bool:
    """Whether the test is at the endpoint, where every other process meets it first."""
    return True


@pytest.fixture
def site(tmp_path, endpoint, listens) -> Iterator[Site]:
    site = Site(tmp_path, endpoint, listens=listens)
    yield site
    site.close()


class Terminal:
    """`fantwin replay` at a terminal of its own."""

    def __init__(self, words: list[object]) -> None:
        self.ours, theirs = pty.openpty()
        self.before = termios.tcgetattr(theirs)
        self.process = subprocess.Popen(
            [*FANTWIN, *map(str, words)],
            stdin=theirs,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=lambda: os.close(os.open(os.ttyname(0), os.O_RDWR)),  # noqa: PLW1509  its controlling terminal
        )
        self.theirs = theirs

    def press(self, keys: bytes) -> None:
        os.write(self.ours, keys)

    def end(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=DEADLINE_S)
        return self.process.returncode, out, err

    def is_restored(self) -> bool:
        return termios.tcgetattr(self.theirs) == self.before

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()
        os.close(self.ours)
        os.close(self.theirs)


@pytest.fixture
def terminals() -> Iterator[list[Terminal]]:
    opened: list[Terminal] = []
    yield opened
    for terminal in opened:
        terminal.close()


@pytest.mark.slow
def test_at_full_speed_stages_take_every_message_change_to_the_learned_twins_and_decide_every_sample(
    tmp_path, endpoint
):
    """No stage has a twin of its own."""
    recorded_site = RecordedSite(tmp_path, 7, raw_samples=4, learns=True)
    recorded_site.run(300)
    for number in (1, 2):
        twin = write_twin(tmp_path / f"{number}.onnx", small_hybrid(number), fans=3, name=f"tray1-{number}")
        recorded_site.put_in_force(f"tray1-{number}", twin.read_bytes())
        recorded_site.run(200)
    source = recorded_site.finished().rename(tmp_path / "source.mcap")
    settings, file = (f"site='{SITE}'", SILENCE), tmp_path / "site.toml"
    chain = Chain(tmp_path / "run", endpoint, *settings, stages=WORKING, configuration=file)
    try:
        up = chain.start_up()
        with chain.watcher() as watcher:
            eventually(lambda: {v.health.stage for v in watcher.stages() if v.alive} == set(WORKING), "all are there")
        done = as_typed("replay", source, "--rate", "max", "--from-topic", "raw", "--json", *chain.words("")[1:])
        status, account = up.end(), up.output()
    finally:
        chain.close()
    assert (done.returncode, status) == (0, 0), (done.stdout, done.stderr, account, up.lines[-20:])
    report = json.loads(done.stdout)
    assert report["messages"] == {"raw": 700 // 4, "new_twin": 2}
    assert (report["lost"], report["behind"], report["stopped"]) == ({}, [], False)
    assert set(report["listeners"]) == {"recorder", "resampler"}
    then, now = (messages_by_topic(path) for path in (source, tmp_path / "run" / "recording.mcap"))
    assert [raw.header.sequence for raw in now["raw"]] == list(range(700 // 4))
    assert {raw.header.producer.startswith("replay-") for raw in now["raw"]} == {True}
    changes = [[(card.twin, card.t_ns) for card in found["twin"]] for found in (then, now)]
    assert changes[0] == changes[1]
    assert [twin for twin, _ in changes[0]] == ["tray1-1", "tray1-2"]
    columns = (("grid", "t_ns"), ("prediction", "predicted_speed_rad_s"), ("score", "t_ns"), ("score", "score"))
    for topic, column in columns:
        before, after = (np.concatenate([getattr(each, column) for each in found[topic]]) for found in (then, now))
        np.testing.assert_array_equal(before, after[: len(before)], f"{topic} {column}")  # then comes the silence


def messages_by_topic(path: Path) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    for entry in read_recording(path):
        found.setdefault(entry.topic, []).append(entry.message)
    return found


def test_a_replay_paused_for_longer_than_the_watermark_gives_the_grid_of_a_resampler_that_nothing_pauses(
    site, tmp_path, terminals
):
    recording = write_raw(tmp_path / "source.mcap", 500, missing=range(200, 300))
    core = ResamplerCore(8, ResamplerConfig(rate_hz=100.0))
    expected = [grid for entry in read_recording(recording) for grid in core.step(cast(Raw, entry.message))]
    site.start("resampler")
    terminals.append(Terminal(site.words(recording, "--from-topic", "raw", "--rate", 8, "--json")))
    while site.next(Clock).t_ns < START_NS + 10**9:
        pass
    terminals[0].press(b" ")
    while site.next(Clock).rate:
        pass
    paused = [site.next(Clock) for _ in range(30)]  # 20 a second
    assert {(clock.t_ns, clock.rate) for clock in paused} == {(paused[0].t_ns, 0.0)}
    terminals[0].press(b" ")
    status, out, err = terminals[0].end()
    assert status == 0, (out, err)
    assert 0.0 < json.loads(out)["rate"] < 8.5, "a busy machine plays more slowly, none faster"
    found = site.grids_until(START_NS + 499 * STEP_NS)
    for name in ("t_ns", "command", "speed_rad_s", "valid", "invalid_reason"):
        then, now = (np.concatenate([getattr(grid, name) for grid in grids]) for grids in (expected, found))
        assert len(then) > 490
        np.testing.assert_array_equal(now[: len(then)], then, name)
    valid = np.concatenate([grid.valid for grid in expected])
    assert valid[:199].all() and not valid[210:290].any(), "the gap is there"


def test_at_a_terminal_it_steps_and_quits_and_gives_the_terminal_back(site, tmp_path, terminals):
    recording = write_raw(tmp_path / "source.mcap", 500)
    terminal = Terminal(site.words(recording, "--pause", "--json"))
    terminals.append(terminal)
    clock = site.next(Clock)
    assert (clock.t_ns, clock.rate) == (START_NS, 0.0)
    for step in range(1, 4):
        terminal.press(b"s" if step % 2 else b"\x1b[C")
        while (t_ns := site.next(Clock).t_ns) < START_NS + (step - 1) * STEP_NS + 2_000_000:
            pass
        assert t_ns == START_NS + (step - 1) * STEP_NS + 2_000_000
    assert not terminal.is_restored()
    terminal.press(b"q")
    status, out, err = terminal.end()
    assert status == 0, err
    assert terminal.is_restored()
    report = json.loads(out)
    assert report["stopped"]
    assert report["messages"] == {"raw": 3}


def test_a_stage_that_writes_what_a_replay_writes_ends_it_and_keeps_the_next_from_starting(site, tmp_path):
    recording = write_raw(tmp_path / "source.mcap", 3000)
    running = RunningCommand(site.words(recording, "--topics", "raw,grid"))
    site.running.append(running)
    site.next(Clock)
    site.start("resampler")
    assert running.process.wait(DEADLINE_S) == 1
    writes = "resampler of site 'demo' is running and writes grid itself"
    assert writes in running.lines[-1]
    while site.next(Health).status != StageStatus.STOPPED:
        pass
    refused = site.replay(recording)
    assert (refused.returncode, refused.stderr) == (1, f"fantwin: {writes}: replay with --from-topic raw, or stop it\n")


@pytest.mark.parametrize("listens", [False], ids=["the replay is met first"])
def test_row_07_beside_a_replay_no_site_and_no_acquisition_starts_and_a_signal_ends_it_cleanly(
    site, tmp_path, terminals
):
    recording = write_raw(tmp_path / "source.mcap", 500)
    terminal = Terminal(site.words(recording, "--rate", 0.01))
    terminals.append(terminal)
    while not site.next(Health).outputs:
        pass
    assert not terminal.is_restored()
    up = fantwin(*site.chain.words("up"))
    acquisition = fantwin("up", "--only", "acquisition", *site.chain.words("")[1:])
    assert (up.returncode, acquisition.returncode) == (1, 1)
    endpoint = site.chain.endpoint
    assert up.stderr == (
        f"fantwin: a replay presents site 'demo' at {endpoint}: stop it, leave acquisition out of launcher.stages, or "
        "give this one another site or bus.endpoint\n"
    )
    assert acquisition.stderr == (
        "fantwin: a replay presents site 'demo': stop it, or give acquisition/tray1 another site or bus.endpoint\n"
    )
    while not site.heard[Clock].empty():
        site.next(Clock)
    site.next(Clock)
    terminal.process.send_signal(signal.SIGTERM)
    status, _, err = terminal.end()
    assert status == 0, err
    assert terminal.is_restored()
    while (last := site.next(Health)).status != StageStatus.STOPPED:
        pass
    assert last.outputs[0].key == tray_key(SITE, TRAY, "raw")


def test_unreadable_parts_are_reported_in_the_output_and_the_exit_code(tmp_path, endpoint):
    whole = write_raw(tmp_path / "whole.mcap", 2000)
    truncated = tmp_path / "truncated.mcap"
    truncated.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    done = as_typed("replay", truncated, "--rate", "max", "--set", f"bus.endpoint={endpoint}", "--json")
    assert done.returncode == 3
    assert "truncated.mcap" in done.stderr
    assert f"no stage on site 'demo' at {endpoint} reads raw" in done.stderr
    report = json.loads(done.stdout)
    assert report["damage"]
    assert 0 < report["messages"]["raw"] < 2000
    none = as_typed("replay", whole, "--from-topic", "grid", "--set", f"bus.endpoint={endpoint}")
    expected = f"fantwin: {whole}: it holds no grid, or none between --from and --to"
    assert (none.returncode, none.stderr.splitlines()[-1]) == (1, expected)
