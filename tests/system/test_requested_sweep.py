"""A sweep that an operator starts by the API on a running site: however it ends, the fans get their commands back."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from fantwin.pipeline.recordings.reading import read_recording
from fantwin.schemas.enums import Action
from fantwin.schemas.messages import Raw, Request
from tests.support.ports import free_port
from tests.support.running_chain import Chain, RunningCommand, eventually, fantwin
from tests.support.running_gateway import Client
from tests.support.site_users import PASSWORD, make_users

pytestmark = [pytest.mark.slow, pytest.mark.real_time]
SWEEP = "/api/v1/trays/tray1/sweep"
STAGES = '["acquisition", "resampler", "twin_integrator", "scorer", "recorder", "learner", "gateway"]'
FORMER = 0.4


@pytest.fixture
def site(tmp_path: Path, endpoint: str, new_chain: Callable[..., Chain]) -> Chain:
    """A tray without a twin, whose learner lets operators move its fans."""
    make_users(tmp_path / "users.toml")
    path = tmp_path / "fantwin.toml"
    path.write_text(
        f'run_folder = "runs"\n[bus]\nendpoint = "{endpoint}"\n[[tray]]\nname = "tray1"\nfans = ["CPU", "rear"]\n'
        f'port = "{tmp_path / "line"}"\n[recorder]\ntopics = ["raw"]\n[learner]\nsweep_on_request = true\n'
        f'[gateway]\nport = {free_port()}\nusers = "users.toml"\n[launcher]\nstages = {STAGES}\n',
        encoding="utf-8",
    )
    return new_chain(configuration=path)


def client_of(site: Chain, name: str) -> Client:
    port = int(
        site.configuration.read_text(encoding="utf-8").partition("port = ")[2].partition("port = ")[2].split()[0]
    )
    client = Client(SimpleNamespace(port=port))  # type: ignore[arg-type]

    def is_in() -> bool:
        try:
            return client.log_in(name, PASSWORD) == 200
        except OSError:
            return False

    eventually(is_in, "the gateway answers")
    return client


def test_stopped_killed_or_ended_with_the_site_a_sweep_gives_the_fans_their_commands_back(
    tmp_path: Path, site: Chain, start_command: Callable[..., RunningCommand]
) -> None:
    line = ("--link", tmp_path / "line", "--profile", "manual", "--set", "rate_hz=20", "--json")
    start_command("simulate", "--fans", 2, *line).line_with("fans on")
    site.up = up = RunningCommand(["up", "-c", site.configuration, "--json"])
    ann, vic = client_of(site, "ann"), client_of(site, "vic")

    def sweep() -> dict[str, str]:
        status, said, _ = ann.ask("GET", SWEEP)
        return said if status == 200 else dict.fromkeys(("plan", "running", "ended"), "")

    def commands() -> list[float]:
        return [each["command"] for each in ann.ask("GET", "/api/v1/fans?tray=tray1")[1]["fans"]]

    plan = eventually(lambda: sweep()["plan"], "the learner may be asked")
    assert plan.startswith("CPU (fan 0), rear (fan 1) of tray1: commands from 0.2 to 1, 20% to 100% of its range, "), (
        plan
    )
    assert vic.ask("POST", SWEEP, {})[0] == 403
    for fan in ("CPU", "rear"):  # the simulated tray then leaves the commands to fantwin
        words = ("command", "-c", site.configuration, "--fan", fan, FORMER)
        eventually(lambda words=words: not fantwin(*words).returncode, "acquisition takes a command")
    eventually(lambda: commands() == [FORMER] * 2, "the fans have their commands")

    def begin() -> None:
        _, said, _ = eventually(lambda: (found := ann.ask("POST", SWEEP, {}))[0] == 200 and found, "it begins")
        assert said["running"], said
        eventually(lambda: " of 46: command " in sweep()["running"], "it says what it does", every_s=0.2)
        eventually(lambda: commands() != [FORMER] * 2, "the fans are moved", every_s=0.2)

    begin()
    refused = ann.ask("POST", "/api/v1/fans/tray1/0/requests", {"action": "out_of_service"})
    assert refused[0] == 409 and refused[1]["error"].startswith("tray tray1 has no twin yet (")
    assert ann.ask("DELETE", SWEEP, {})[0] == 200
    left = (
        f"stopped; the fans are left at the commands they had before: CPU (fan 0) {FORMER}, rear (fan 1) {FORMER}; "
        "`fantwin command` sets others"
    )
    eventually(lambda: sweep()["ended"] == left, "it has stopped", every_s=0.2)
    eventually(lambda: commands() == [FORMER] * 2, "the fans have their commands after a stop", every_s=0.2)

    begin()
    os.kill(site.process_ids()["learner"], signal.SIGKILL)
    had = "the fans have their commands though their learner was killed"
    eventually(lambda: commands() == [FORMER] * 2, had, every_s=0.2)

    begin()
    assert up.end() == 0, up.lines
    (recording,) = map(Path, up.output()["recordings"])
    messages = [envelope.message for envelope in read_recording(recording)]
    moved = [message.command for message in messages if isinstance(message, Raw)]
    assert moved[-1][-1].tolist() == pytest.approx([FORMER] * 2), "acquisition ends after the learner"
    asked = [(each.action, each.operator_name) for each in messages if isinstance(each, Request)]
    again = [(Action.SWEEP, "ann")] * (len(asked) - 2)  # also what the killed learner was asked
    assert asked == [(Action.SWEEP, "ann"), (Action.STOP_SWEEP, "ann"), *again]
    assert len(again) >= 2
