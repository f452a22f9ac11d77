"""`fantwin status` and what it looks at: stages, rates, losses and alarms of a site, seen from outside."""

from __future__ import annotations

import io
import itertools
import json
import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from fantwin.pipeline.bus.publisher import Publisher
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.cli.watch import status as status_command
from fantwin.pipeline.cli.watch.commission_state import RECORDING_ONLY, Unfinished
from fantwin.pipeline.cli.watch.status import as_json, loss_lines, not_judged, stage_table
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.config.shards import process_list
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.site.stage_states import StageState, StageView, Word
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.enums import InvalidReason, Severity, StageStatus, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.health import Counter, Health, Input, Output
from fantwin.schemas.messages import Alarm, Diagnosis
from fantwin.schemas.topics import BY_NAME, alive_key, health_key, tray_key
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.current_alarms import clock
from tests.support import made_messages
from tests.support.fantwin_command import error_of
from tests.support.fantwin_command import fantwin as fantwin_here
from tests.support.running_chain import DEMO, FANS, SITE, TRAY, RunningCommand, eventually
from tests.support.score_data import one_sample
from tests.support.stub_bus import SCORER, StubBus

HEALTH = made_messages.health(
    "scorer",
    t_ns=1_700_000_000 * NS_PER_S,
    inputs=(Input(key="k", producer="p", received=100, missing=3, duplicated=0, next_sequence=103),),
    outputs=(Output(key="o", published=50),),
    counters=(Counter(name="lost_on_purpose", value=4),),
    latency_p50_ms=1.5,
    latency_p99_ms=2.5,
    lost=7,
    process_id=4711,
)
ALARM = made_messages.alarm(
    2, 1_700_000_000 * NS_PER_S, producer="scorer-all-1", message="fan 2 is slower than its twin"
)
ALARM_KEY = tray_key("s", TRAY, "alarm")
TRAYS = load_config(DEMO / "demo.toml").trays


class Site:
    """A made-up stage on a real bus."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint, self.bus = endpoint, Bus(BusConfig(endpoint=endpoint))
        self.health = self._publisher(health_key(SITE, "scorer", "all"), "health")
        self.alarm = self._publisher(tray_key(SITE, TRAY, "alarm"), "alarm")
        self.score = self._publisher(tray_key(SITE, TRAY, "score"), "score")
        self.bus.declare_alive(alive_key(SITE, "scorer", "all"))

    def _publisher(self, key: str, topic: str) -> Publisher:
        return self.bus.publisher(key, BY_NAME[topic], type_name(BY_NAME[topic].message), HEALTH.header.producer)


@pytest.fixture
def site(endpoint: str) -> Iterator[Site]:
    site = Site(endpoint)
    yield site
    site.bus.close()


@pytest.fixture
def stub() -> Any:
    return StubBus()


def watching(stub: Any, health: Health) -> SiteWatcher:
    """A watcher that has heard the health of the scorer, and whoever asks gets the alarms of before."""
    watcher = SiteWatcher(stub, "s", trays=TRAYS, has_scores=True)
    stub.show(SCORER)
    stub.say(health)
    watcher.ask_for_past_alarms()
    return watcher


def judge(watcher: SiteWatcher, *reasons: InvalidReason) -> None:
    """Let it hear a score; reasons: why fans are not judged, beginning with fan 0."""
    watcher.model.add_decoded_score(TRAY, one_sample(FANS, *reasons))


ONLY_THE_SCORER = 'launcher.stages=["scorer"]'


def shown(watcher: SiteWatcher, *settings: str) -> str:
    console = Console(width=120, file=io.StringIO(), record=True)
    console.print(stage_table(watcher, load_config(DEMO / "demo.toml", [ONLY_THE_SCORER, *settings])))
    return console.export_text()


def document(watcher: SiteWatcher) -> Any:
    """What a machine reads."""
    return json.loads(json.dumps(as_json(watcher, load_config(DEMO / "demo.toml", [ONLY_THE_SCORER]))))


def status_words(site: Site) -> list[object]:
    endpoint = f"bus.endpoint='{site.endpoint}'"
    return ["status", "-c", DEMO / "demo.toml", "--set", endpoint, "--set", ONLY_THE_SCORER]


def test_row_10_what_was_refused_in_the_name_of_another_is_said_and_is_no_loss(stub):
    refusals = (Counter(name="refused_forged", value=12),)
    watcher = watching(stub, replace(HEALTH, inputs=(), counters=refusals, lost=0))
    assert "scorer: refused: 12 messages in the name of another session\n" in shown(watcher)
    assert watcher.losses() == {"scorer": 0}


def test_stages_rates_losses_problems_and_alarms_from_before_the_watcher_came_are_shown(stub):
    stub.kept = [(ALARM_KEY, encode(ALARM))]
    watcher = watching(stub, replace(HEALTH, problem="the line is silent"))
    judge(watcher)
    reported = document(watcher)
    (stage,), (alarm,) = reported["stages"], reported["alarms"]
    assert (stage["stage"], stage["alive"], stage["status"], stage["process_id"]) == ("scorer", True, "ok", 4711)
    assert (stage["state"], stage["lost"], reported["not_judged"]) == ("ok", 7, [])
    assert stage["counters"] == {"lost_on_purpose": 4}
    assert stage["latency_ms"] == {"p50": 1.5, "p99": 2.5}
    assert (alarm["tray"], alarm["fan"], alarm["active"]) == (TRAY, 2, True)
    assert "scorer: the line is silent" in shown(watcher)


def test_alarms_are_shown_with_their_states_and_probable_causes(stub):
    over = {"active": False, "acknowledged": True}
    shelved = {"fan": 4, "onset_t_ns": 0, "severity": Severity.NONE, "shelved_until_t_ns": 2**63 - 1, **over}
    cause = Diagnosis(cause="drag_up", probability=0.87)
    for number, more in enumerate(
        (
            {"transition": Transition.DIAGNOSED, "causes": (cause,), "message": "fan 2: more drag"},
            {"transition": Transition.ACKNOWLEDGED, "causes": (cause,), "acknowledged": True},
            {"transition": Transition.CLEARED, "fan": 3, "onset_t_ns": 7, **over},
            {"transition": Transition.SHELVED, **shelved},
        )
    ):
        header, changes = Header("scorer-all-1", number, TRAY), {"t_ns": ALARM.t_ns + number}
        stub.kept.append((ALARM_KEY, encode(replace(ALARM, header=header, **changes | more))))
    watcher = watching(stub, HEALTH)
    judge(watcher, *[InvalidReason.NONE] * 2, InvalidReason.STOPPED)
    text = " ".join(shown(watcher).split())
    assert "fan 2: active, acknowledged, now stopped by its command, more drag 87 %; " in text
    assert f"at {clock(ALARM.t_ns)}: more drag" in text
    assert "fan 3" not in text, "it is over, and everybody knows"
    assert "fan 4: never raised, shelved until it clears" in text
    reported = {alarm["fan"]: alarm for alarm in document(watcher)["alarms"]}
    assert (reported[2]["acknowledged"], reported[2]["causes"][0]["cause"]) == (True, "drag_up")
    assert (reported[3]["retained"], reported[4]["presented"]) == (False, False)


def test_row_01_a_missing_stage_has_a_row_and_no_alarms_is_not_said_while_a_fan_is_not_judged(stub):
    watcher = watching(stub, HEALTH)
    judge(watcher)
    watcher.model._fleet._judged_s[0] = -np.inf
    judge(watcher, InvalidReason.NO_SPEED)
    text = shown(watcher, 'launcher.stages=["resampler", "scorer"]')
    assert re.search(r"resampler +missing", text)
    assert "resampler: not seen on the bus" in text
    assert "tray1: fan 0 not judged: no speed" in text
    assert "no alarms" not in text
    assert document(watcher)["not_judged"] == [{"tray": TRAY, "fans": [0], "why": "no speed"}]


def test_a_site_without_a_scorer_is_well_and_does_not_say_that_there_are_no_alarms(stub):
    watcher = SiteWatcher(stub, "s", trays=TRAYS, has_scores=True)
    recorder = replace(HEALTH, stage="recorder", header=Header("recorder-all-1", 0, ""))
    line = Input(key="fantwin/demo/tray1/raw", producer="p", received=9, missing=3, duplicated=0, next_sequence=12)
    state = StageState("recorder", Word.OK, "", StageView(replace(recorder, inputs=(line,)), None, alive=True), True)
    console = Console(width=120, file=io.StringIO(), record=True)
    assert not_judged([state], watcher.model) == []
    assert not_judged([replace(state, label="scorer")], watcher.model) != []
    assert loss_lines([state]) == ["recorder: lost since its start: lost_on_purpose 4, missing on tray1/raw 3"]
    config = load_config(DEMO / "demo.toml", ['launcher.stages=["recorder"]'])
    console.print(stage_table(watcher, config))
    text = console.export_text()
    assert "no fan is judged: the configuration has no scorer" in text
    assert "no alarms" not in text


def test_a_stage_that_vanished_is_shown_as_gone_and_without_stages_no_table_and_alarms_are_unknown(stub):
    watcher = watching(stub, HEALTH)
    stub.show(SCORER, alive=False)
    gone, empty = shown(watcher), shown(SiteWatcher(stub, "s", trays=TRAYS, has_scores=True))
    assert "gone" in gone and "stages" not in empty
    for text in (gone, empty):
        assert "no stage of site 'demo' answers at tcp/" in text
        assert "alarms unknown: no scorer is alive" in text
        assert "no alarms" not in text


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Callable[[], str], int]]:
    """A pseudo-terminal: the text written to it so far, without colours, and the side that a process writes to."""
    monkeypatch.setenv("TERM", "xterm")
    master, slave = os.openpty()
    written: list[bytes] = []

    def read() -> None:
        with suppress(OSError):  # raised once nobody holds the other side
            while chunk := os.read(master, 4096):
                written.append(chunk)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    yield lambda: re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", b"".join(written).decode(errors="replace")), slave
    os.close(slave)
    reader.join(10.0)
    os.close(master)


def test_on_a_terminal_the_view_stays_live_until_it_is_stopped(site, terminal):
    written, slave = terminal
    live = RunningCommand(status_words(site), stdout=slave)

    def shows(lost: int) -> bool:
        now = time.time_ns()
        site.health.put(encode(replace(HEALTH, t_ns=now, lost=lost, header=Header("scorer-all-1", now, ""))))
        site.score.put(encode(one_sample(FANS)))
        return f" {lost} " in written()

    try:
        eventually(lambda: shows(7), "the first health is shown")
        eventually(lambda: shows(4321), "a later health is shown in its place")
        assert live.end() == 3
    finally:
        live.kill()


@contextmanager
def beating(site: Site, health: Health, alarm: Alarm | None = None) -> Iterator[None]:
    """A stage that reports its health and judges its fans, ten times a second, beside the block."""
    stop = threading.Event()

    def beat() -> None:
        for number in itertools.count():
            site.health.put(encode(replace(health, t_ns=HEALTH.t_ns + number)))
            site.score.put(encode(one_sample(FANS)))
            if alarm:
                site.alarm.put(encode(replace(alarm, header=Header("scorer-all-1", number, TRAY))))
            if stop.wait(0.1):
                return

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def test_into_a_pipe_a_running_site_is_shown_once_and_a_loss_is_exit_code_3_and_a_problem_1(site, monkeypatch):
    monkeypatch.setattr(status_command, "_LISTEN_S", 0.5)
    monkeypatch.setattr(status_command, "_LISTEN_MAX_S", 60.0)
    name, *words = status_words(site)
    with beating(site, HEALTH):
        for more in (("--json",), ()):
            done = fantwin_here(str(name), *words, *more)
            assert done.exit_code == 3 and "scorer" in done.stdout, done
    broken = replace(HEALTH, lost=0, inputs=(), status=StageStatus.DEGRADED, problem="NOTHING IS RECORDED: \x1b[2Jfull")
    with beating(site, replace(broken, t_ns=HEALTH.t_ns), replace(ALARM, message="\x1b[31mslow")):
        done = fantwin_here(str(name), *words)
    assert done.exit_code == 1, done
    assert "NOTHING IS RECORDED" in done.stdout and "[31mslow" in done.stdout
    assert "\x1b" not in done.stdout, "a text of an alarm moves no cursor"


def test_a_probe_asks_for_one_process_only_and_is_answered_as_soon_as_that_is_known(site, monkeypatch):
    name, *words = status_words(site)
    site.health.put(encode(replace(HEALTH, problem="the disk is full", status=StageStatus.DEGRADED)))

    def asked(*more: str) -> tuple[int, str]:
        done = fantwin_here(str(name), *words, *more)
        return done.exit_code, done.stdout

    monkeypatch.setattr(status_command, "_LISTEN_MAX_S", 60.0)
    assert asked("--stage", "scorer") == (0, "scorer: degraded: the disk is full\n"), (
        "it is at work, with losses or not"
    )
    monkeypatch.setattr(status_command, "_LISTEN_MAX_S", 0.3)
    assert asked("--stage", "recorder") == (1, "recorder: missing: not seen on the bus\n")
    site.health.put(encode(replace(HEALTH, status=StageStatus.STARTING)))
    code, line = asked("--stage", "scorer", "--json")
    assert (code, json.loads(line)["state"]) == (1, "starting"), "it has not caught up"


def test_into_a_pipe_a_site_without_stages_is_one_line(endpoint, monkeypatch):
    monkeypatch.setattr(status_command, "_LISTEN_MAX_S", 0.3)
    words = ("status", "-c", DEMO / "demo.toml", "--once", "--set", f"bus.endpoint='{endpoint}'")
    assert f"no stage of site 'demo' answers at {endpoint}" in error_of(*words)


def test_while_fans_are_commissioned_only_the_stages_that_record_are_expected(endpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(status_command, "_LISTEN_S", 0.5)
    monkeypatch.setattr(status_command, "_LISTEN_MAX_S", 1.0)
    here = (f"bus.endpoint='{endpoint}'", f"run_folder='{tmp_path}'")
    words = ("-c", DEMO / "demo.toml", *(word for each in here for word in ("--set", each)))
    config = load_config(DEMO / "demo.toml", [*here, *RECORDING_ONLY[1::2]])
    healths = [
        made_messages.health(row.stage, row.instance, f"{row.stage}-{row.instance}-1") for row in process_list(config)
    ]
    stop = threading.Event()

    def beat(bus: Bus, of: Health) -> None:
        key, sequence = health_key(SITE, of.stage, of.instance), itertools.count()
        publisher = bus.publisher(key, BY_NAME["health"], type_name(Health), of.header.producer)
        while not stop.wait(0.1):
            now = time.time_ns()
            publisher.put(encode(replace(of, t_ns=now, header=Header(of.header.producer, next(sequence), ""))))

    def asked(*more: str) -> tuple[int, str]:
        done = fantwin_here("status", *words, *more)
        return done.exit_code, done.stdout

    with ExitStack() as running:
        unfinished = running.enter_context(Unfinished(tmp_path))
        unfinished.show("makes the twin of tray tray1")
        line = "commissioning: makes the twin of tray tray1; no fan is judged before `fantwin up`\n"
        assert asked() == (0, line), "it runs no stage meanwhile"
        with Bus(BusConfig(endpoint=endpoint)) as bus:
            for each in healths:
                bus.declare_alive(alive_key(SITE, each.stage, each.instance))
            beats = [threading.Thread(target=beat, args=(bus, each)) for each in healths]
            for each in beats:
                each.start()
            try:
                code, text = asked("--json")
                running.close()
                after, _ = asked()
            finally:
                stop.set()
                for each in beats:
                    each.join()
    shown = json.loads(text)
    states = [(each["stage"], each["state"]) for each in shown["stages"]]
    assert (code, states) == (0, [(name, "ok") for name in ("acquisition", "resampler", "recorder")])
    assert shown["commissioning"] == "makes the twin of tray tray1"
    assert after == 1, "afterwards all stages are expected"
