"""`fantwin sweep`: the excitation of simulated fans, in simulated time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from pipeline.cli.watch.excitation import (
    LEVELS,
    SETTLING,
    SHORT_LEVELS,
    Excitation,
    Observed,
    StoppedError,
    has_settled,
    time_constants,
)
from pipeline.cli.watch.sweep import range_within
from pipeline.config.loading import load_config
from pipeline.config.models import TrayConfig
from pipeline.devices.serial_config import SerialConfig
from pipeline.errors import UserError
from pipeline.learning.ordinary_operation import OrdinaryOperation
from tests.support.fantwin_command import error_of
from tests.support.running_chain import DEMO

PERIOD_S = 0.1


class FirstOrderFans:
    """Fans whose speed follows the command with a time constant; reported at 10 Hz with noise."""

    def __init__(self, time_constants_s: list[float], top_rad_s: float = 300.0, stop_after_s: float = np.inf) -> None:
        self.tau_s = np.array(time_constants_s)
        self.top_rad_s = np.full(len(time_constants_s), top_rad_s)
        self.command = np.full(len(time_constants_s), 0.4)
        self.speed = self.top_rad_s * self.command
        self.now_s, self.stop_after_s = 0.0, stop_after_s
        self.sent: list[tuple[float, dict[int, float]]] = []
        self.forced: float | None = None
        self._rng = np.random.default_rng(1)
        self._rows: list[tuple[float, np.ndarray, np.ndarray]] = []
        self._sample()

    def send(self, values: Mapping[int, float]) -> None:
        self.sent.append((self.now_s, dict(values)))
        for fan, value in values.items():
            self.command[fan] = value
        self._rows = self._rows[-1:]

    def observed(self) -> Observed:
        t_s, command, speed = zip(*self._rows, strict=True)
        return Observed(np.array(t_s) - t_s[0], np.array(command), np.array(speed))

    def wait(self, seconds: float) -> bool:
        for _ in range(round(seconds / PERIOD_S)):
            self.now_s += PERIOD_S
            self.speed += (self.top_rad_s * self.command - self.speed) * (1 - np.exp(-PERIOD_S / self.tau_s))
            self._sample()
        return self.now_s >= self.stop_after_s

    def _sample(self) -> None:
        command = self.command.copy() if self.forced is None else np.full_like(self.command, self.forced)
        self._rows.append((self.now_s, command, self.speed + self._rng.normal(0.0, 2.0, len(self.speed))))


def swept(line: FirstOrderFans, rounds: int = 1, low: float = 0.2, high: float = 1.0) -> tuple[dict, list[str]]:
    said: list[str] = []
    fans = range(len(line.tau_s))
    return Excitation(line, list(fans), low, high, rounds, said.append).run(), said


@pytest.mark.parametrize("slowest_s", [0.4, 1.5, 6.0])
def test_each_level_lasts_until_the_slowest_fan_has_settled(slowest_s: float) -> None:
    line = FirstOrderFans([slowest_s / 2, slowest_s])
    found, said = swept(line)
    assert found[1] == pytest.approx(slowest_s, rel=0.25, abs=2 * PERIOD_S)
    steps = line.sent[3:]
    durations_s = np.diff([at_s for at_s, _ in steps])
    assert durations_s[: len(LEVELS)] == pytest.approx(SETTLING * found[1], rel=0.1)
    assert (durations_s[len(LEVELS) :] < 0.4 * durations_s[0]).all()
    assert sum("step " in words for words in said) == len(LEVELS) + len(SHORT_LEVELS)
    assert said[-1].startswith("step 23 of 23: command ")


def test_all_levels_of_the_range_are_passed_and_none_outside() -> None:
    line = FirstOrderFans([0.5])
    swept(line, rounds=2)
    values = [value for _, sent in line.sent for value in sent.values()]
    assert (min(values), max(values)) == (0.2, 1.0)
    assert len(set(np.round(values, 3))) >= 15


@pytest.mark.parametrize("fans", [2, 3, 4, 5, 6, 7, 8])
def test_the_load_of_all_fans_does_not_follow_any_one_of_them(fans: int) -> None:
    line = FirstOrderFans([0.5] * fans)
    swept(line)
    commands = np.array([[sent[fan] for fan in range(fans)] for _, sent in line.sent[3:]])
    for levels, rows in ((LEVELS, slice(len(LEVELS))), (SHORT_LEVELS, slice(len(LEVELS), None))):
        for of_fan in commands[rows].T:
            assert sorted(of_fan) == pytest.approx(sorted(0.2 + 0.8 * level for level in levels))
        assert commands[rows].mean(axis=1).std() < 0.6 * commands[rows, 0].std()


def test_ctrl_c_ends_it_at_once() -> None:
    line = FirstOrderFans([1.0], stop_after_s=20.0)
    with pytest.raises(StoppedError):
        swept(line)
    assert line.now_s < 30.0


def test_a_fan_that_does_not_follow_is_named_and_the_others_go_on() -> None:
    line = FirstOrderFans([1.0, 1.0])
    line.top_rad_s[1] = 0.0
    line.speed[1] = 0.0
    found, said = swept(line)
    assert np.isfinite(found[0])
    assert np.isnan(found[1])
    assert "fan 1: does not follow its command" in said


@pytest.mark.parametrize("missing", [[0], [-1], [0, 30, 55, -1]])
def test_readings_that_are_missing_hide_no_fan(missing: list[int]) -> None:
    t_s = np.arange(60) * PERIOD_S
    whole = (300.0 * (1.0 - np.exp(-t_s / 0.5)))[:, np.newaxis]
    holed = whole.copy()
    holed[missing] = np.nan
    assert has_settled(t_s, holed)
    assert time_constants(t_s, holed) == pytest.approx(time_constants(t_s, whole), abs=2 * PERIOD_S)


def test_where_something_else_sets_the_command_it_says_so() -> None:
    line = FirstOrderFans([1.0])
    line.forced = 0.5
    with pytest.raises(UserError, match=r"fan 0 has command 0.5 and not 0.2: something else sets it"):
        swept(line)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--low 0.5 --high 0.4", "name a range within 0 to 1 of tray tray1"),
        ("--high 255", "name a range within 0 to 1 of tray tray1"),
        ("--fans 0,8", "tray tray1 has fans 0 to 7"),
        ("--fans both", "write all, or numbers with commas"),
        ("--safe 2", "--safe 2: the command must be within 0 to 1"),
    ],
)
def test_what_the_tray_cannot_do_is_refused_in_one_line(words: str, expected: str) -> None:
    assert expected in error_of("sweep", "-c", DEMO / "demo.toml", *words.split())


UNCOMMANDED = [
    ('kind = "push"', "the program that pushes its samples moves the fans"),
    ('kind = "http"', "whatever posts its samples moves the fans"),
    ('kind = "mqtt", host = "broker", topic = "t"', "its source names no send_topic"),
    ('kind = "hwmon", chip = "nct6798"', "its source does not have writable = true"),
    ('kind = "redfish", url = "https://bmc"', "fans behind Redfish are only read"),
]


def configured(folder: Path, source: str) -> Path:
    path = folder / "fantwin.toml"
    path.write_text(f'[[tray]]\nname = "tray1"\nfans = 1\nspeed_unit = "rpm"\nsource = {{ {source} }}\n')
    return path


@pytest.mark.parametrize(("source", "reason"), UNCOMMANDED)
def test_a_tray_that_takes_no_commands_is_not_swept_and_one_line_says_what_to_do_instead(
    tmp_path: Path, source: str, reason: str
) -> None:
    path = configured(tmp_path, source)
    for words, instead in (
        (("sweep",), "run `fantwin up` while the fans' own controller varies their commands; it is recorded"),
        (("commission", "--sweep"), "leave out --sweep, and let the fans' own controller vary their commands"),
        (("command", "--fan", "0", "0.5"), ""),
    ):
        error = error_of(words[0], "-c", path, *words[1:])
        assert f"tray tray1 takes no commands, {reason}" in error
        assert instead in error


@pytest.mark.parametrize(
    ("source", "hint"),
    [
        ('kind = "push"', "the fans' own controller must vary their commands"),
        ('kind = "mqtt", host = "broker", topic = "t", send_topic = "c"', "`fantwin sweep` moves the fans"),
    ],
)
def test_a_sweep_is_advised_only_where_it_can_be_done(tmp_path: Path, source: str, hint: str) -> None:
    (tray,) = load_config(configured(tmp_path, source), stages=()).trays
    assert OrdinaryOperation(tray).how_to_move == hint


@pytest.mark.parametrize(("low", "high", "expected"), [(0, 255, (51, 255)), (20, 70, (30, 70)), (-1, 1, (-1, 1))])
def test_without_low_no_fan_is_to_stop(low: float, high: float, expected: tuple[float, float]) -> None:
    source = SerialConfig(port="line")
    tray = TrayConfig(name="tray1", fans=1, source=source, command_min=low, command_max=high)
    assert range_within(tray, None, None, None) == pytest.approx(expected)
    assert range_within(tray, low, None, None) == (low, high)


def test_a_fan_that_reads_0_at_the_lowest_command_is_named_at_once() -> None:
    class StandsBelow(FirstOrderFans):
        def observed(self) -> Observed:
            seen = super().observed()
            return seen._replace(speed_rad_s=np.where(seen.command < 0.3, 0.0, seen.speed_rad_s))

    _, said = swept(StandsBelow([0.5]))
    assert said[1] == "fan 0 reads 0 at command 0.2; if it stands, give a higher --low"
    _, said = swept(StandsBelow([0.5]), low=0.0)
    assert not [line for line in said if "reads 0" in line], "it is meant to stand"
