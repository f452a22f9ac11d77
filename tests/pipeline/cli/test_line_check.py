"""`fantwin doctor` listens to the line, and names what does not fit the configuration."""

from __future__ import annotations

import os
import threading
import time
import tty
from collections.abc import Iterable
from itertools import count, repeat
from pathlib import Path

import numpy as np
import pytest

import fantwin.client
from fantwin.pipeline.cli.watch.line_check import _findings, check_line, refusal
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.models import Config
from fantwin.pipeline.runtime.stage import Context
from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S
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


def samples(rate_hz: float, command: float, speed_rad_s: float, fans: int = 2) -> list[Raw]:
    return [
        Raw(
            fans=fans,
            host_receive_t_ns=np.array([round((1e9 + k / rate_hz) * NS_PER_S)]),
            command=np.full((1, fans), command),
            speed_rad_s=np.full((1, fans), speed_rad_s + k),
        )
        for k in range(max(3, round(2 * rate_hz)))
    ]


def found(rate_hz: float, command: float = 0.5, speed_rad_s: float = 300.0, fans: int = 2, **keys: object) -> list:
    config = config_of(**keys)
    return list(_findings(samples(rate_hz, command, speed_rad_s, fans), config.trays[0], config, None))


@pytest.mark.parametrize(("line_hz", "grid_hz", "gap_s"), [(1, 1, "5"), (10, 10, "0.5"), (100, 100, "0.1")])
def test_a_line_that_fits_is_shown_with_its_grid_and_ranges(line_hz: float, grid_hz: int, gap_s: str) -> None:
    rate, ranges, _ = found(line_hz, tray__0__speed_unit="rpm")
    assert rate == (True, f"{line_hz} samples a second: grid of {grid_hz} Hz, gaps are longer than {gap_s} s")
    assert ranges[0]
    assert ranges[1].startswith("commands 0.5 to 0.5 (of 0 to 1), speeds 2865 to ")


@pytest.mark.parametrize(
    ("tacho", "said"),
    [
        (
            None,
            (
                False,
                '(`tacho = { kind = "count", pulses = 2, window_s = 1.0 }` in [[tray]]); declared is instantaneous',
            ),
        ),
        ('{kind="count", window_s=1.0}', (True, "tachos of fans 0, 1: they read as declared")),
    ],
)
def test_tachos_that_count_are_found_in_what_a_line_sends(tacho: str | None, said: tuple[bool, str]) -> None:
    """A minute of fans that speed up and slow down, counted over a second and sent ten times a second."""
    config = config_of(**({"tray__0__tacho": tacho} if tacho else {}))
    count_rad_s = 2.0 * np.pi / 2.0
    at_s = np.arange(600) / 10.0
    speed = 150.0 + 100.0 * np.sin(2.0 * np.pi * np.floor(at_s) / 31.0)
    line = [
        Raw(
            fans=2,
            host_receive_t_ns=np.array([round((1e9 + second) * NS_PER_S)]),
            command=np.full((1, 2), 0.5),
            speed_rad_s=np.full((1, 2), count_rad_s * np.floor(now / count_rad_s)),
        )
        for second, now in zip(at_s, speed, strict=True)
    ]
    *_, (ok, text) = _findings(line, config.trays[0], config, None)
    assert ok == said[0]
    assert said[1] in text
    *_, (is_fine, short) = _findings(line[:20], config.trays[0], config, None)
    assert is_fine
    assert short.startswith("commands" if tacho else "fans 0, 1: not shown whether the tacho counts; listen")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (
            {"rate_hz": 10, "resampler__rate_hz": 100},
            "too few for resampler.gap_limit_s = 0.1: leave out rate_hz",
        ),
        ({"rate_hz": 0.2}, "0.2 samples a second: too slow to be judged; let the device send at least 1 a second"),
        ({"rate_hz": 10, "speed_rad_s": 9000.0}, 'speeds up to 9019 rad/s: is speed_unit "rpm"?'),
        ({"rate_hz": 10, "speed_rad_s": float("nan")}, "no speed of fan 0, 1: is its tacho connected?"),
        ({"rate_hz": 10, "fans": 3}, "samples of 3 fans, [[tray]] says fans = 2: correct one of them"),
    ],
)
def test_what_does_not_fit_is_one_line_that_says_what_to_do(line: dict, words: str) -> None:
    problems = [text for ok, text in found(**line) if not ok]
    assert len(problems) == 1
    assert words in problems[0]


def listened(sent: Iterable[tuple[float, bytes]], seconds: float) -> list:
    """What is found of a device that sends these lines, each so many seconds after the one before."""
    master, slave = os.openpty()
    tty.setraw(slave)
    stop = threading.Event()

    def device() -> None:
        for pause_s, line in sent:
            if stop.wait(pause_s):
                return
            os.write(master, line)

    sender = threading.Thread(target=device)
    sender.start()
    try:
        port, unit = {"tray__0__port": f"'{os.ttyname(slave)}'"}, {"tray__0__speed_unit": "rpm"}
        config = config_of(**port, **unit)
        context = Context(
            site="site", trays=config.trays, config=config.sections["acquisition"], folder=Path(), run_folder=Path(),
            started_t_ns=0,
        )  # fmt: skip
        return check_line(context, config, seconds, is_running=False)
    finally:
        stop.set()
        sender.join()
        os.close(slave)
        os.close(master)


def test_a_port_is_listened_to_as_acquisition_does() -> None:
    clock_us = count(20_000, 20_000)
    each = (f"S {us} {us // 20_000} 117 1200 117 1200\n".encode() for us in clock_us)
    ((is_fine, line),) = listened(zip(repeat(0.02), each, strict=False), 1.0)
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
        ({"samples": 200, "absurd_speed": 4}, "absurd_speed 4;"),
    ],
)
def test_a_line_that_was_cut_once_is_no_fault_of_the_configuration(counters: dict[str, int], words: str) -> None:
    said = refusal(counters)
    assert words in said if words else not said


def of_push(config: Config, *, is_running: bool) -> list:
    """What is found of a tray whose samples are pushed."""
    context = Context(
        site=SITE, trays=config.trays, config=config.sections["acquisition"], folder=Path(), run_folder=Path(),
        started_t_ns=0,
    )  # fmt: skip
    return check_line(context, config, 1.0, is_running=is_running)


def test_before_a_site_runs_pushed_samples_are_no_problem_and_are_said_to_be_checked_later(
    endpoint: str, tmp_path: Path
) -> None:
    ((is_fine, line),) = of_push(push_config(endpoint, tmp_path), is_running=False)
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
            lines = of_push(config, is_running=True)
        finally:
            stop.set()
            sender.join()
    assert [line for ok, line in lines if not ok] == ["tray1: no speed of fan 1: is its tacho connected?"]
