"""Adding an output stage takes a file with its declaration and a row in the registry, and nothing else.

The file here is this one: a stage that appends each alarm to a text file. In the product it would be
`stages/alarm_log.py`, and the row a line of `pipeline.config.registry.STAGES`.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.models import ConfigError
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.shards import process_list
from fantwin.pipeline.plugins import StageRow
from fantwin.pipeline.runtime.runner import Runner
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Core, Stage, StageConfig, load_stage
from fantwin.schemas.codec import decode, encode, type_name
from fantwin.schemas.enums import Severity, StageStatus
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Alarm, Message
from fantwin.schemas.topics import BY_NAME, health_key, tray_key

# --- the new file: stages/alarm_log.py ---


class AlarmLogConfig(StageConfig):
    """Section `[alarm_log]`."""

    file: Path


class AlarmLog(Core):
    """Appends a line for each alarm message of any tray."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", encoding="utf-8")
        self._lines = 0

    def step(self, item: Alarm) -> Sequence[Message]:
        self._file.write(f"{item.header.tray} fan {item.fan}: {item.message}\n")
        self._lines += 1
        return ()

    def close(self) -> Sequence[Message]:
        self._file.close()
        return ()

    def abort(self) -> None:
        self._file.close()

    def counters(self) -> Mapping[str, int]:
        return {"lines": self._lines}


def build(context: Context) -> BuiltStage:
    return BuiltStage(AlarmLog(context.resolve(context.config.file)))


STAGE = Stage(
    name="alarm_log",
    about="appends each alarm to a text file",
    reads=("alarm",),
    writes=(),
    config=AlarmLogConfig,
    build=build,
    core_per_tray=False,
)

# --- the new row of the registry ---

ROW = StageRow("alarm_log", f"{__name__}:STAGE", enabled_by="section", scope="site")

# --- what that gives ---

SITE = '[[tray]]\nname = "a"\nfans = 2\n[[tray]]\nname = "b"\nfans = 2\n'
SECTION = '[alarm_log]\nfile = "alarms.txt"\n'


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(STAGES, ROW.name, ROW)


def parse(text: str, folder: Path, *overrides: str) -> Any:
    return parse_config(text, folder / "fantwin.toml", overrides)


def test_a_registered_stage_starts_nothing_until_the_configuration_has_its_section(tmp_path):
    config = parse(SITE, tmp_path)
    assert "alarm_log" not in config.stages
    assert "alarm_log" not in config.sections
    assert "alarm_log" not in [row.stage for row in process_list(config)]


def test_its_section_enables_it_and_its_scope_says_how_many_processes(tmp_path, monkeypatch):
    config = parse(SITE + SECTION, tmp_path)
    assert [row.label for row in process_list(config) if row.stage == "alarm_log"] == ["alarm_log"]
    monkeypatch.setitem(STAGES, ROW.name, StageRow("alarm_log", ROW.declaration, scope="tray"))
    assert [row.label for row in process_list(config) if row.stage == "alarm_log"] == ["alarm_log/a", "alarm_log/b"]


def test_launcher_stages_overrides_the_section(tmp_path):
    assert parse(SITE + SECTION, tmp_path, 'launcher.stages=["recorder"]').stages == ("recorder",)


def test_its_section_is_checked_like_any_other(tmp_path):
    with pytest.raises(ConfigError, match=r"unknown key 'alarm_log.fiel'; did you mean 'file'\?"):
        parse(SITE + SECTION.replace("file", "fiel"), tmp_path)


def test_the_runner_runs_it(tmp_path, endpoint):
    config = parse(SITE + SECTION, tmp_path, f"bus.endpoint='{endpoint}'")
    stop, ready, written = threading.Event(), threading.Event(), threading.Event()
    with Bus(config.bus) as bus:

        def on_health(_key: str, payload: bytes) -> None:
            health = decode(Health, payload)
            assert isinstance(health, Health)
            if health.status == StageStatus.OK:
                ready.set()
            if ("lines", 2) in {(counter.name, counter.value) for counter in health.counters}:
                written.set()

        bus.subscribe(health_key("site", "alarm_log", "all"), on_health)
        runner = Runner(load_stage("alarm_log"), config, None, stop)
        last: list[Health] = []
        thread = threading.Thread(target=lambda: last.append(runner.run()))
        thread.start()
        assert ready.wait(20)
        for tray in ("a", "b"):
            publisher = bus.publisher(tray_key("site", tray, "alarm"), BY_NAME["alarm"], type_name(Alarm), "scorer-1")
            publisher.put(encode(alarm(tray)))
        assert written.wait(20)
        stop.set()
        thread.join(20)
    assert sorted((tmp_path / "alarms.txt").read_text().splitlines()) == ["a fan 1: too slow", "b fan 1: too slow"]
    assert (last[0].status, last[0].lost) == (StageStatus.STOPPED, 0)


def alarm(tray: str) -> Alarm:
    return Alarm(
        header=Header("scorer-1", 0, tray),
        fan=1,
        active=True,
        severity=Severity.ALARM,
        t_ns=1,
        onset_t_ns=1,
        residual_rad_s=-3.0,
        residual_std_rad_s=2.0,
        message="too slow",
    )
