"""`fantwin command`: what is wanted of a fan reaches its line, or one line says why not."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import Result

from fantwin.pipeline.acquisition import command_sender
from tests.support.fantwin_command import error_of, fantwin
from tests.support.running_chain import DEADLINE_S, Chain, RunningCommand, eventually


@pytest.fixture
def chain(tmp_path: Path, endpoint: str) -> Iterator[Chain]:
    chain = Chain(tmp_path, endpoint)
    yield chain
    chain.close()


def test_what_the_line_did_not_take_is_one_line_that_says_why_and_a_note_names_what_was_probably_meant(
    chain, monkeypatch
):
    monkeypatch.setattr(command_sender, "_ANSWER_S", DEADLINE_S)  # a command waits for the acquisition, which starts
    acquisition = RunningCommand(["up", "--only", "acquisition", *chain.words("run")[1:]])
    try:
        error = error_of(*chain.words("command"), "--fan", 3, 0.5)  # there is no tray
        assert "tray tray1: the command failed: " in error and str(chain.port) in error
        chain.start_tray()
        words = (*chain.words("command"), "--set", "tray.0.command_max=255", "--json")

        def sent() -> Result | None:
            done = fantwin(*words, "--fan", 3, 0.6)
            return None if done.exit_code else done

        done = eventually(sent, "the acquisition takes a command")
    finally:
        acquisition.kill()
    assert json.loads(done.stdout)["value"] == 0.6
    assert done.stderr == "note: commands of tray tray1 go from 0 to 255, and 0.6 was sent; 60 % of this range is 153\n"


def test_without_an_acquisition_the_command_is_reported_as_not_received(chain, monkeypatch):
    monkeypatch.setattr(command_sender, "_ANSWER_S", 0.1)
    expected = "no acquisition of tray tray1 received the command: is `fantwin up` running?"
    assert error_of(*chain.words("command"), "--fan", 3, 0.5) == expected
