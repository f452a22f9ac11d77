"""Samples that a program prints: what it reads, what it prints, when it is ended."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources import polling
from fantwin.pipeline.sources.exec.config import ExecConfig
from fantwin.pipeline.sources.exec.source import ExecSource
from fantwin.pipeline.sources.source import LinkDown, SourceContext
from tests.support.delivered import Delivered
from tests.support.running_chain import eventually

SAMPLE = json.dumps({"command": [0.5, 0.5], "speed": [100, 101]})
Run = Callable[..., tuple[ExecSource, Delivered]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    """Runs a script of the shell as the program of a source."""
    for name in ("RECONNECT_DELAY_S", "RECONNECT_DELAY_MAX_S"):
        monkeypatch.setattr(polling, name, 0.02)
    sources: list[ExecSource] = []

    def start(script: str, *arguments: str, **settings: Any) -> tuple[ExecSource, Delivered]:
        program = tmp_path / "program"
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
        config = ExecConfig(program=("./program", *arguments), **settings)
        sources.append(ExecSource(config, SourceContext(2, "rpm", tmp_path)))
        events = Delivered()
        sources[-1].start(events.append)
        return sources[-1], events

    yield start
    for source in sources:
        source.stop()


def test_its_arguments_are_words_that_no_shell_reads_and_it_runs_beside_the_configuration(
    run: Run, tmp_path: Path
) -> None:
    run('printf "%s\\n" "$@" > said; pwd >> said; exec cat', "a b", "$HOME", "*; rm -r /")
    eventually(lambda: (tmp_path / "said").exists() and (tmp_path / "said").read_text().count("\n") == 4, "it ran")
    assert (tmp_path / "said").read_text().splitlines() == ["a b", "$HOME", "*; rm -r /", str(tmp_path)]


def test_one_that_ends_is_started_again_and_its_last_words_are_the_reason(run: Run) -> None:
    said = "echo starting >&2; echo 'no device at /dev/fan: plug it in' >&2"
    _, events = run(f"echo '{SAMPLE}'; {said}; exit 3")
    eventually(lambda: len(events.readings) >= 2, "it was started again")
    down = next(event for event in events.links if isinstance(event, LinkDown))
    assert down.reason.startswith("it ended with exit code 3: no device at /dev/fan: plug it in; it is started again")
    _, events = run("kill -9 $$")
    eventually(lambda: events.links, "it ended")
    assert events.links == [LinkDown("it ended with signal 9; it is started again, and has to run on")]


def test_with_the_source_ends_the_program_and_what_it_has_started(run: Run, tmp_path: Path) -> None:
    source, events = run(f"sleep 1000 & echo $! $$ > pids; echo '{SAMPLE}'; wait")
    eventually(lambda: events.readings, "it runs")
    pids = [int(pid) for pid in (tmp_path / "pids").read_text().split()]
    source.stop()
    eventually(lambda: not any(map(_runs, pids)), "both have ended")


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_one_that_does_not_end_when_it_is_asked_is_killed(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fantwin.pipeline.sources.exec.source.END_LIMIT_S", 0.1)
    source, events = run(f"trap '' TERM; echo '{SAMPLE}'; while :; do sleep 0.01; done")
    eventually(lambda: events.readings, "it runs")
    process = source._process
    assert process
    source.stop()
    assert process.poll() == -9


def test_what_it_has_started_is_killed_though_the_program_itself_ends(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fantwin.pipeline.sources.exec.source.END_LIMIT_S", 0.1)
    helper = "(trap '' TERM; while :; do sleep 0.01; done) & echo $! > pid"
    source, events = run(f"{helper}; echo '{SAMPLE}'; sleep 1000")
    eventually(lambda: events.readings, "it runs")
    source.stop()
    pid = int((tmp_path / "pid").read_text())
    eventually(lambda: not _runs(pid), "its helper has ended")


def test_commands_are_lines_of_json_and_what_it_shows_confirms_them(run: Run) -> None:
    show = 'while read line; do echo "$line" >> heard; echo "$line" | sed s/}/,\\"speed\\":[1,2]}/; done'
    source, events = run(f"echo '{SAMPLE}'; {show}", commands=True)
    assert source.send((0.2, 0.4), ()) in ("", "./program does not run")
    eventually(lambda: events.readings, "it runs")
    assert source.send((0.25, 0.75), ()) == ""
    eventually(lambda: events.readings[-1].command == (0.25, 0.75), "it shows the command")


def test_one_that_reads_no_commands_does_not_stop_the_stage(run: Run) -> None:
    source, events = run(f"echo '{SAMPLE}'; exec sleep 1000", commands=True)
    eventually(lambda: events.readings, "it runs")
    found = [source.send((0.5, 0.5) * 500, ()) for _ in range(100)]
    assert found[0] == "" and found[-1] == "./program does not read its commands"
    source, events = run(f"echo '{SAMPLE}'; exec sleep 1000")
    assert source.send((0.5, 0.5), ()) == "its source does not have commands = true"


def test_json_of_its_own_is_read_by_pointers_and_a_line_that_is_none_costs_itself(run: Run) -> None:
    own = '{"at": 1790000000, "fans": [{"rpm": "900 rpm", "pwm": 40}, {"rpm": null, "pwm": 50}]}'
    pointers = {"speed_key": "/fans/{0}/rpm", "command_key": "/fans/{0}/pwm", "time_key": "/at"}
    _, events = run(f"echo 'sensors v3'; echo '{own}'; exec sleep 1000", **pointers)
    eventually(lambda: events.readings, "it is read")
    (refused,) = events.refused
    assert refused.kind == "malformed" and "'sensors v3': no JSON" in refused.detail
    assert str(events.readings[0].speed) == "(900.0, nan)" and events.readings[0].command == (40, 50)
    assert events.readings[0].clock_us == 1_790_000_000 * 10**6 % 2**32
    with pytest.raises(UserError, match="speed_key has one speed for 2 fans"):
        run("", speed_key="/rpm", command_key="/pwm")


def test_what_is_no_program_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("")
    for program in ("./none", "./text", "no-such-program-anywhere", ""):
        source = ExecSource(ExecConfig(program=(program,)), SourceContext(2, "rpm", tmp_path))
        (problem,) = source.check()
        assert problem.startswith(f"{program}: no program of this name that can be run: correct source.program")
        events = Delivered()
        source.start(events.append)
        eventually(lambda events=events: events.links, "it says so")
        source.stop()
        (link,) = events.links
        assert isinstance(link, LinkDown) and link.reason.startswith("cannot be run: ") and "\n" not in link.reason
    assert ExecSource(ExecConfig(program=("cat",)), SourceContext(1, "rpm", tmp_path)).check() == []
