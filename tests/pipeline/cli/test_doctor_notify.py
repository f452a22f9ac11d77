"""`fantwin doctor notify` sends a test message; `fantwin doctor` finds what would keep messages from being sent."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from fantwin.pipeline.cli.watch.doctor import doctor
from tests.support.fantwin_command import error_of, fantwin, usage_error_of
from tests.support.message_receivers import HttpReceiver
from tests.support.notified_alarms import secret
from tests.support.ports import free_port

CONFIGURATION = """
site = "hall"
run_folder = "runs"
[[tray]]
name = "tray1"
fans = 8
[launcher]
stages = ["notifier"]
[notifier]
page = "https://hall.example"
[[notifier.target]]
name = "hook"
url_file = "hook.url"
[[notifier.target]]
name = "other"
kind = "alertmanager"
url_file = "other.url"
"""


@pytest.fixture
def receiver() -> Iterator[HttpReceiver]:
    server = HttpReceiver()
    yield server
    server.stop()


def site(folder: Path, receiver: HttpReceiver, alertmanager_port: int) -> Path:
    secret(folder, "hook", f"json://127.0.0.1:{receiver.port}/")
    secret(folder, "other", f"http://127.0.0.1:{alertmanager_port}")
    config = folder / "fantwin.toml"
    config.write_text(CONFIGURATION)
    return config


def test_each_target_gets_a_test_message(tmp_path, receiver):
    config = site(tmp_path, receiver, receiver.port)
    done = fantwin("doctor", "notify", "-c", config)
    assert (done.exit_code, done.stdout) == (0, "hook: delivered\nother: delivered\n")
    message, (alert,) = receiver.received
    assert message["title"] == "Test (hall)"
    assert "A test of target hook of the notifier at hall." in message["message"]
    assert alert["labels"] == {"alertname": "FantwinTest", "site": "hall", "severity": "none"}


def test_one_that_is_away_is_named_and_the_others_get_theirs(tmp_path, receiver):
    config = site(tmp_path, receiver, free_port())
    done = fantwin("doctor", "notify", "-c", config, "--json")
    hook, other = map(json.loads, done.stdout.splitlines())
    assert hook == {"target": "hook", "delivered": True, "reason": ""}
    assert not other["delivered"] and "refused" in other["reason"]
    assert error_of("doctor", "notify", "-c", config) == "no test message for other"
    assert fantwin("doctor", "notify", "hook", "-c", config).stdout == "hook: delivered\n"
    assert "no target nobody: there is hook, other" in usage_error_of("doctor", "notify", "nobody", "-c", config)


def test_doctor_reads_secrets_and_urls(tmp_path, receiver, capsys):
    config = site(tmp_path, receiver, receiver.port)

    def problems() -> list[str]:
        with pytest.raises(typer.Exit):
            doctor(config=config, json_output=True, listen_s=0.0)
        found = json.loads(capsys.readouterr().out)
        return [line for line in found["problems"] if line.startswith("notifier")]

    (tmp_path / "hook.url").chmod(0o644)
    assert ["others may read it" in line for line in problems()] == [True]
    secret(tmp_path, "hook", "mailto://127.0.0.1/?from=f@hall.example&to=ann@hall.example,bob@hall.example")
    assert ["recipients" in line for line in problems()] == [True]
