"""`fantwin doctor` listens to the line, and names what does not fit the configuration."""

from __future__ import annotations

import threading
import time
from contextlib import closing
from itertools import count
from pathlib import Path

import numpy as np
import pytest

import fantwin.client
from fantwin.pipeline.cli.watch.line_check import Finding, _findings, check_line, refusal
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.runtime.stage import Context
from fantwin.pipeline.sources.simulated.device import PseudoTerminal
from fantwin.schemas.messages import Array, Raw
from fantwin.schemas.units import NS_PER_S
from tests.support.made_messages import filled
from tests.support.running_acquisition import SITE, acquisition, push_config

TOML = """
[[tray]]
name = "tray1"
fans = 2
protocol = "text"
"""


def config_of(**keys: object) -> Config:
    overrides = [f"{key.replace('__', '.')}={value}" for key, value in keys.items()]
    return parse_config(TOML, Path("fantwin.toml"), overrides, ("acquisition", "resampler"))


def context_of(config: Config) -> Context:
    """What acquisition and its one tray need."""
    section = config.sections["acquisition"]
    return Context("site", config.trays, section, folder=Path(), run_folder=Path(), started_t_ns=0)


def line_of(at_s: Array, speed_rad_s: Array, fans: int = 2) -> list[Raw]:
    """A sample at each time, of fans of one speed."""
    return [
        filled(Raw, 1, fans, host_receive_t_ns=round((1e9 + second) * NS_PER_S), command=0.5, speed_rad_s=speed)
        for second, speed in zip(at_s, speed_rad_s, strict=True)
    ]


def found(rate_hz: float, speed_rad_s: float = 300.0, fans: int = 2, **keys: object) -> list[Finding]:
    config, numbers = config_of(**keys), np.arange(max(3, round(2 * rate_hz)))
    line = line_of(numbers / rate_hz, speed_rad_s + numbers, fans)
    return list(_findings(line, config.trays[0], config, None, {}))


@pytest.mark.parametrize(("line_hz", "grid_hz", "gap_s"), [(1, 1, "5"), (10, 10, "0.5"), (100, 100, "0.1")])
def test_a_line_that_fits_is_shown_with_its_grid_and_ranges(line_hz: float, grid_hz: int, gap_s: str) -> None:
    rate, ranges, _ = found(line_hz, tray__0__speed_unit="rpm")
    assert rate == (True, f"{line_hz} samples a second: grid of {grid_hz} Hz, gaps are longer than {gap_s} s")
    assert ranges[0]
    assert ranges[1].startswith("fans 0, 1: commands 0.5 to 0.5 (of 0 to 1), speeds 2865 to ")


@pytest.mark.parametrize(
    ("tacho", "is_fine", "said"),
    [
        (
            None,
            False,
            '(`tacho = { kind = "count", pulses = 2, window_s = 1.0 }` in [[tray]]); declared is instantaneous',
        ),
        ('{kind="count", window_s=1.0}', True, "tachos of fans 0, 1: they read as declared"),
    ],
)
def test_tachos_that_count_are_found_in_what_a_line_sends(tacho: str | None, is_fine: bool, said: str) -> None:
    """A minute of fans that speed up and slow down, counted over a second and sent ten times a second."""
    config = config_of(**({"tray__0__tacho": tacho} if tacho else {}))
    at_s = np.arange(600) / 10.0
    speed = 150.0 + 100.0 * np.sin(2.0 * np.pi * np.floor(at_s) / 31.0)
    line = line_of(at_s, np.pi * np.floor(speed / np.pi))
    *_, (ok, text) = _findings(line, config.trays[0], config, None, {})
    assert ok == is_fine and said in text
    *_, (ok, short) = _findings(line[:20], config.trays[0], config, None, {})
    unseen = "fans 0, 1: not shown whether the tacho counts or holds; "
    assert ok and short.startswith(
        "fans 0, 1: commands" if tacho else f"{unseen}listen while the speeds change: --listen-s 60"
    )
    *_, (ok, steady) = _findings(line_of(at_s, np.full(600, 150.0)), config.trays[0], config, None, {})
    assert ok and steady.startswith("fans 0, 1: commands" if tacho else f"{unseen}write `tacho` in [[tray]]"), (
        "it has listened"
    )


def test_a_speed_that_is_shown_once_a_second_is_found_in_what_a_line_sends_twice_a_second() -> None:
    config, at_s = config_of(), np.arange(120) / 2.0
    line = line_of(at_s, 150.0 + 100.0 * np.sin(2.0 * np.pi * np.floor(at_s) / 31.0))
    *_, (ok, text) = _findings(line, config.trays[0], config, None, {})
    assert not ok
    assert '`tacho = { kind = "average", window_s = 0.05, update_s = 1.0 }` in [[tray]]' in text


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (
            {"rate_hz": 10, "resampler__rate_hz": 100},
            "too few for resampler.gap_limit_s = 0.1: leave out rate_hz",
        ),
        ({"rate_hz": 0.01}, "a sample every 100 s: too slow to be judged; let the device send one a minute"),
        ({"rate_hz": 10, "speed_rad_s": 9000.0}, 'speeds up to 9019 rad/s: is speed_unit "rpm"?'),
        ({"rate_hz": 10, "speed_rad_s": float("nan")}, "no speed of fans 0, 1: is its tacho connected?"),
        ({"rate_hz": 10, "fans": 3}, "samples of 3 fans, [[tray]] says fans = 2: correct one of them"),
    ],
)
def test_what_does_not_fit_is_one_line_that_says_what_to_do(line: dict, words: str) -> None:
    problems = [text for ok, text in found(**line) if not ok]
    assert len(problems) == 1
    assert words in problems[0]


def test_a_port_is_listened_to_as_acquisition_does() -> None:
    stop = threading.Event()
    with closing(PseudoTerminal()) as device:

        def send() -> None:
            for number in count():
                if stop.wait(0.02):
                    return
                device.write(f"S {20_000 * number} {number} 117 1200 117 1200\n".encode())

        sender = threading.Thread(target=send)
        sender.start()
        try:
            config = config_of(tray__0__port=f"'{device.port}'", tray__0__speed_unit="rpm")
            ((is_fine, line),) = check_line(context_of(config), config, 1.0, is_running=False)
        finally:
            stop.set()
            sender.join()
    assert not is_fine
    assert "command 117 is outside command_min = 0 to command_max = 1" in line


@pytest.mark.parametrize(
    ("counters", "words"),
    [
        ({"samples": 200}, ""),
        ({"samples": 199, "refused_input": 1, "wrong_fan_count": 1, "lost_on_line": 3}, ""),
        ({"samples": 19, "refused_input": 1, "truncated": 1}, ""),
        ({"samples": 197, "refused_input": 3, "truncated": 3}, "3 of the inputs cannot be used: truncated 3; see"),
        (
            {"samples": 199, "refused_input": 1, "absurd_command": 1},
            "1 of the inputs cannot be used: absurd_command 1;",
        ),
        ({"samples": 200, "absurd_speed": 4}, "4 speeds are beyond speed_max and count as missing: correct speed_max"),
    ],
)
def test_a_line_that_was_cut_once_is_no_fault_of_the_configuration(counters: dict[str, int], words: str) -> None:
    said = refusal(counters)
    assert words in said if words else not said


def test_before_a_site_runs_pushed_samples_are_no_problem_and_are_said_to_be_checked_later(
    endpoint: str, tmp_path: Path
) -> None:
    config = push_config(endpoint, tmp_path)
    ((is_fine, line),) = check_line(context_of(config), config, 1.0, is_running=False)
    assert is_fine
    assert line.startswith("tray1: clients push its samples: they are checked only while `fantwin up` runs;")


def test_while_a_site_runs_pushed_samples_are_listened_to(endpoint: str, tmp_path: Path) -> None:
    config, stop = push_config(endpoint, tmp_path), threading.Event()

    def push(tray: fantwin.client.Tray) -> None:
        while not stop.wait(0.05):
            tray.publish(time.time(), [0.25, 0.5], [1500.0, 20_000.0 * 2])

    with acquisition(config), fantwin.client.connect(endpoint, site=SITE) as client:
        sender = threading.Thread(target=push, args=(client.tray("tray1", speed_unit="rpm"),))
        sender.start()
        try:
            lines = check_line(context_of(config), config, 1.0, is_running=True)
        finally:
            stop.set()
            sender.join()
    assert [line for ok, line in lines if not ok] == ["tray1: no speed of fan 1: is its tacho connected?"]


def test_a_fan_without_a_command_is_named_and_shown_by_its_speed_alone() -> None:
    line = line_of(np.arange(50) / 10.0, np.full(50, 150.0))
    for raw in line:
        raw.command[:, 1] = np.nan
    said = _findings(line, config_of().trays[0], config_of(), None, {})
    assert (None, "fan 1: no command is known, so not judged: say in source where it is, or write command_from") in said
    (shown,) = [text for _, text in said if text.startswith("fan 1: speeds")]
    assert "nan" not in shown


def test_a_source_whose_samples_are_all_refused_is_said_with_the_reason(tmp_path: Path) -> None:
    """One that is asked so rarely that its health has no problem yet."""
    (tmp_path / "fans").write_text('#!/bin/sh\necho \'{"command": [null, null], "speed": [1, 2]}\'; exec sleep 100\n')
    (tmp_path / "fans").chmod(0o755)
    text = '[[tray]]\nname = "a"\nfans = 2\nsource = { kind = "exec", program = ["./fans"] }\n'
    config = parse_config(text, tmp_path / "fantwin.toml", stages=("acquisition",))
    context = Context(SITE, config.trays, config.sections["acquisition"], tmp_path, tmp_path, 0)
    ((is_fine, line),) = check_line(context, config, 0.2, is_running=False)
    assert not is_fine and "the command of no fan is known" in line
