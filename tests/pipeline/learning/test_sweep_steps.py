"""The excitation of simulated fans, in simulated time, and when a plant has moved its fans enough without one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.ordinary_operation import OrdinaryOperation
from fantwin.pipeline.learning.sweep_steps import (
    LEVELS,
    SETTLING,
    SHORT_LEVELS,
    Excitation,
    Observed,
    StoppedError,
)
from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S
from tests.support.first_order_fans import PERIOD_S, FirstOrderFans


def swept(line: FirstOrderFans, rounds: int = 1, low: float = 0.2, high: float = 1.0) -> tuple[dict, list[str]]:
    said: list[str] = []
    fans = range(len(line.tau_s))
    return Excitation(line, list(fans), low, high, rounds, said.append).run(), said


@pytest.mark.parametrize("slowest_s", [0.4, 6.0])
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


def test_readings_that_a_device_holds_for_a_second_do_not_end_a_probe_too_early() -> None:
    """Two equal readings were taken for a speed that has settled, so that one fan had 3.5 s and later 5.5 s."""

    class Holds(FirstOrderFans):
        def observed(self) -> Observed:
            seen = super().observed()
            shown = np.searchsorted(seen.t_s, np.floor(seen.t_s))
            return seen._replace(speed_rad_s=seen.speed_rad_s[shown])

    found, said = swept(Holds([3.0]))
    assert 2.9 <= found[0] <= 4.1, "at most one reading late"
    assert f"23 steps, {75.0 * found[0] / 60.0:.1f} min" in said


@pytest.mark.parametrize("fans", [1, 5])
def test_each_fan_passes_all_levels_of_the_range_and_the_load_of_all_does_not_follow_any_one_of_them(
    fans: int,
) -> None:
    line = FirstOrderFans([0.5] * fans)
    swept(line, rounds=2)
    values = [value for _, sent in line.sent for value in sent.values()]
    assert (min(values), max(values)) == (0.2, 1.0)
    assert len(set(np.round(values, 3))) >= 15
    commands = np.array([[sent[fan] for fan in range(fans)] for _, sent in line.sent[3:]])
    for levels, rows in ((LEVELS, slice(len(LEVELS))), (SHORT_LEVELS, slice(len(LEVELS), len(commands) // 2))):
        for of_fan in commands[rows].T:
            assert sorted(of_fan) == pytest.approx(sorted(0.2 + 0.8 * level for level in levels))
        if fans > 1:
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


def test_where_something_else_sets_the_command_it_says_so() -> None:
    line = FirstOrderFans([1.0])
    line.forced = 0.5
    with pytest.raises(UserError, match=r"fan 0 has command 0.5 and not 0.2: something else sets it, its own cont"):
        swept(line)


def configured(folder: Path, source: str) -> Path:
    path = folder / "fantwin.toml"
    path.write_text(f'[[tray]]\nname = "tray1"\nfans = 1\nspeed_unit = "rpm"\nsource = {{ {source} }}\n')
    return path


@pytest.mark.parametrize(
    ("source", "hint"),
    [
        ('kind = "push"', "the fans' own controller must vary their commands"),
        (
            'kind = "mqtt", url = "mqtt://broker", topic = "t", send_topic = "c"',
            "`fantwin command --sweep` moves the fans",
        ),
    ],
)
def test_a_sweep_is_advised_only_where_it_can_be_done(tmp_path: Path, source: str, hint: str) -> None:
    (tray,) = load_config(configured(tmp_path, source), stages=()).trays
    assert OrdinaryOperation(tray).how_to_move == hint


def test_a_fan_that_reads_0_at_the_lowest_command_is_named_at_once() -> None:
    class StandsBelow(FirstOrderFans):
        def observed(self) -> Observed:
            seen = super().observed()
            return seen._replace(speed_rad_s=np.where(seen.command < 0.3, 0.0, seen.speed_rad_s))

    _, said = swept(StandsBelow([0.5]))
    assert said[1] == "fan 0 reads 0 at command 0.2; if it stands still, give a higher --low"
    _, said = swept(StandsBelow([0.5]), low=0.0)
    assert not [line for line in said if "reads 0" in line], "it is meant to stand still"


TRAY = TrayConfig.model_validate({"name": "tray1", "fans": 2, "command_max": 100.0})


def samples(commands: np.ndarray, first_s: float = 0.0, period_s: float = 0.5) -> Raw:
    """Samples of two fans; commands: (n, 2)."""
    n = len(commands)
    t_ns = ((first_s + period_s * np.arange(n)) * NS_PER_S).astype(np.int64)
    return Raw(
        fans=2,
        host_receive_t_ns=t_ns,
        device_clock_us=np.zeros(n, np.uint32),
        device_sequence=np.arange(n, dtype=np.uint32),
        command=commands,
        speed_rad_s=np.ones((n, 2)),
    )


def stairs(levels: list[float], held: int = 50) -> np.ndarray:
    """Two fans, of which the second holds the first level."""
    moved = np.repeat(levels, held)
    return np.column_stack((moved, np.full(len(moved), levels[0])))


def test_a_fan_has_moved_enough_after_enough_levels_and_changes_and_the_others_are_named() -> None:
    operation = OrdinaryOperation(TRAY)
    assert (
        operation.missing()[0]
        == "fan 0: no command so far, still 20 s at each of 4 more levels and 10 more changes by a tenth of 0 to 100"
    )
    operation.take(samples(stairs([20.0, 45.0, 70.0, 95.0, 20.0, 45.0])))
    first, second = operation.missing()
    assert first == "fan 0: commands 20 to 95 so far, still 5 more changes by a tenth of 0 to 100"
    assert (
        second
        == "fan 1: command 20 so far, still 20 s at each of 3 more levels and 10 more changes by a tenth of 0 to 100"
    )
    operation.take(samples(stairs([20.0, 45.0, 70.0, 95.0, 20.0]), first_s=150.0))
    (left,) = operation.missing()
    assert left.startswith("fan 1:")
    assert operation.held() == ["fan 1: command 20"]


def test_a_command_that_flickers_between_two_ranges_does_not_change_and_gaps_do_not_count() -> None:
    operation = OrdinaryOperation(TRAY)
    flickers = np.where(np.arange(400) % 2 == 0, 29.9, 30.1)
    operation.take(samples(np.column_stack((flickers, flickers))))
    assert operation.held() == ["fan 0: commands 29.9 to 30.1", "fan 1: commands 29.9 to 30.1"]
    sparse = OrdinaryOperation(TRAY)
    sparse.take(samples(stairs([20.0, 45.0], held=10), period_s=10.0))
    lacking = sparse.missing()[0]
    more = "still 20 s at each of 4 more levels and 9 more changes by a tenth of 0 to 100"
    assert lacking == f"fan 0: commands 20 to 45 so far, {more}"
