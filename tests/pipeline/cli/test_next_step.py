"""`fantwin` alone says what to do next on this computer, whatever is there."""

from __future__ import annotations

from pathlib import Path

import pytest

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.config.shards import Shard
from fantwin.pipeline.runtime.sessions import Session
from tests.support.fantwin_command import as_typed


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def said() -> list[str]:
    done = as_typed()
    assert (done.returncode, done.stderr) == (0, "")
    *lines, last = done.stdout.splitlines()
    assert last == "fantwin --help lists all commands"
    return lines


def test_each_state_of_this_computer_has_its_next_command(folder: Path, endpoint: str) -> None:
    first, second = said()
    assert first.startswith("no fantwin.toml in this folder; next: fantwin init") and "fantwin demo" in second

    file = folder / "fantwin.toml"
    site = f'site = "hall"\n[bus]\nendpoint = "{endpoint}"\n[[tray]]\nname = "cpu"\nfans = 1\nport = "p"\n'
    file.write_text(f"{site}twinn = 1\n")
    wrong, correct = said()
    assert "unknown key 'tray.0.twinn'" in wrong and correct.startswith("next: correct it; fantwin doctor")

    file.write_text(site)
    first, second, third, last = said()
    assert first == "fantwin.toml: site 'hall', no twin yet of tray cpu"
    assert second.startswith("next: fantwin doctor  ("), "what a line sends is not known"
    assert third.startswith("next: fantwin commission --sweep  (") and last.startswith("or: fantwin up")

    file.write_text(site.replace('port = "p"', 'source = { kind = "push" }'))
    assert said()[2].startswith("next: fantwin commission  ("), "it takes no commands"

    file.write_text(f'{site}twin = "fan.onnx"\n')
    ready = ["fantwin.toml: site 'hall', every tray has a twin", "next: fantwin up  (watches the fans)"]
    assert said() == ready

    with Bus(BusConfig(endpoint=endpoint)) as bus:
        assert said() == ready, "who listens there is of another site"
        bus.declare_alive(Session.of_this_process("scorer", Shard("all", ()), 1, "scorer-all-1").key("hall"))
        assert said() == ["site 'hall' runs; next: fantwin status, fantwin alarms"]
