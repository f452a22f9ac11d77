"""`fantwin command`: what is wanted of a fan reaches its line, or one line says why not; and the sweep of simulated
fans, in simulated time.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from fantwin.pipeline.acquisition import command_sender
from fantwin.pipeline.acquisition.command_sender import NotReceivedError
from fantwin.pipeline.cli.watch import sweep as sweep_module
from fantwin.pipeline.cli.watch.sweep import range_within
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.serial.config import SerialConfig
from tests.support.fantwin_command import error_of, fantwin
from tests.support.first_order_fans import FirstOrderFans
from tests.support.running_chain import DEADLINE_S, DEMO, Chain, RunningCommand, eventually


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


@pytest.mark.parametrize(("low", "high", "expected"), [(0, 255, (51, 255)), (20, 70, (30, 70)), (-1, 1, (-1, 1))])
def test_without_low_no_fan_is_to_stop(low: float, high: float, expected: tuple[float, float]) -> None:
    source = SerialConfig(port="line")
    tray = TrayConfig(name="tray1", fans=1, source=source, command_min=low, command_max=high)
    assert range_within(tray, None, None, None) == pytest.approx(expected)
    assert range_within(tray, low, None, None) == (low, high)


class SweptTray(FirstOrderFans):
    """Six fans whose device carries out the commands of a message in turn, up to the first that it refuses."""

    def __init__(self, refuses: Callable[[int], str] = lambda _fan: "", swept_s: float = 20.0) -> None:
        super().__init__([0.5] * 6)
        self.refuses, self.swept_s = refuses, swept_s
        self.stop = threading.Event()
        self.is_gone = False

    def connect(self) -> np.ndarray:
        return self.command.copy()

    def send(self, values: Mapping[int, float]) -> None:
        if self.now_s > self.swept_s:
            for fan, value in values.items():
                if self.is_gone:
                    raise NotReceivedError("no acquisition of tray tray1 received the command")
                if why := self.refuses(fan):
                    raise UserError(why)
                super().send({fan: value})
        else:
            super().send(values)


SWEEP = ("command", "--sweep", "-c", DEMO / "demo.toml", "--fans", "0,1,2,3,4,5", "--rounds", "1")


def without_bus(tray: SweptTray, monkeypatch: pytest.MonkeyPatch) -> None:

    class NoBus:
        def __enter__(self) -> NoBus:
            return self

        def __exit__(self, *_: object) -> None: ...

        def alive(self, _key: str) -> set[str]:
            return set()

        def declare_alive(self, _key: str) -> None: ...

    monkeypatch.setattr(sweep_module, "join_bus", lambda *_, **__: NoBus())
    monkeypatch.setattr(sweep_module, "_BusLine", lambda *_: tray)


@pytest.mark.parametrize(("safe", "of", "value"), [((), "they had before", 0.4), (("--safe", 0.7), "of --safe", 0.7)])
def test_it_says_why_the_fans_are_left_where_they_are(
    safe: Sequence[object], of: str, value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_bus(SweptTray(swept_s=math.inf), monkeypatch)
    lines = fantwin(*SWEEP, *safe).stdout.splitlines()
    commands = f"the commands {of}: {', '.join(f'fan {fan} {value}' for fan in range(6))}"
    assert f"at the end and after Ctrl-C the fans get {commands}" in lines
    assert lines[-1] == f"done; the fans are left at {commands}; `fantwin command` sets others"


def test_one_fan_that_refuses_its_command_keeps_no_other_from_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    tray = SweptTray(lambda fan: "unit 1 refuses 97" if fan == 4 else "")
    without_bus(tray, monkeypatch)
    error = error_of(*SWEEP)
    assert list(tray.command) == [0.4, 0.4, 0.4, 0.4, tray.command[4], 0.4]
    assert tray.command[4] != 0.4
    by_hand = "THESE FANS KEEP THE LAST COMMAND; send these by hand: fan 4 0.4 (unit 1 refuses 97); "
    assert error == f"{by_hand}the sweep has ended: unit 1 refuses 97"


def test_without_acquisition_all_fans_are_named_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tray = SweptTray()
    tray.is_gone = True
    without_bus(tray, monkeypatch)
    error = error_of(*SWEEP)
    assert "fan 5 0.4 (no acquisition of tray tray1 received the command); the sweep has ended: no acq" in error
