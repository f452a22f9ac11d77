"""Warnings: none for recordings that determine every parameter, and the right one for each that does not."""

import re
from typing import Any

import numpy as np
import pytest

from fantwin.schemas.tacho import Tacho
from fantwin.twin.errors import TwinError
from fantwin.twin.fitting.identifiability import feedback_share, identifiability_warnings
from fantwin.twin.fitting.identification import identify
from fantwin.twin.models.physics import PARAMETER_NAMES
from fantwin.twin.runs import Array, Run
from tests.support import fan_data
from tests.support.controlled_fans import ANSWER_THE_SPEED, LOOPS, plain_fans, runs_of, true_parameters
from tests.support.fan_data import published_run, rough_run

INERTIA, VISCOUS, DRAG = fan_data.PUBLISHED_PARAMETERS[:3]
STEP_S = 1.0 / fan_data.RATE_HZ


def warnings_of(*runs: Run) -> tuple[str, ...]:
    found = identify(runs)
    return identifiability_warnings(runs, found.parameters, found.covariance)


def has_line_with(lines: tuple[str, ...], *words: str) -> bool:
    """Whether one of the lines holds all the words."""
    return any(all(word in line for word in words) for line in lines)


def moved(speed_rad_s: Array, command: Array, load: Array | float = 0.0) -> Array:
    """The published fan one sample later, by midpoint steps of 2 ms."""

    def acceleration(speed: Array) -> Array:
        return (command - load - VISCOUS * speed - DRAG * speed * np.abs(speed)) / INERTIA

    for _ in range(5):
        half = speed_rad_s + 0.5 * STEP_S / 5 * acceleration(speed_rad_s)
        speed_rad_s = speed_rad_s + STEP_S / 5 * acceleration(half)
    return speed_rad_s


def commanded(command: Array, seed: int, noise_rad_s: float = fan_data.NOISE_RAD_S, warm_up_s: float = 0.0) -> Run:
    """The published fan under commands (n, fans) from outside, from a standstill; what is before warm_up_s is cut."""
    rng = np.random.default_rng(seed)
    speed, true = np.zeros(command.shape[1]), np.empty_like(command)
    for k, now in enumerate(command):
        true[k] = speed
        speed = moved(speed, now)
    noisy = true + rng.normal(0.0, noise_rad_s, size=true.shape)
    return Run("commanded", STEP_S * np.arange(float(len(command))), command, noisy).between(warm_up_s, np.inf)


def controlled(
    set_point_rad_s: Array,
    seed: int,
    *,
    proportional: float = 0.5,
    integral_per_s: float = 1.0,
    delay: int = 0,
    every: int = 1,
    smoothing: float = 0.0,
    noise_rad_s: float = fan_data.NOISE_RAD_S,
) -> Run:
    """Published fans under a PI controller that is fed the measured, noisy speed. set_point_rad_s: (n, fans).

    delay: samples between measurement and answer. every: samples between answers. smoothing: of a first-order filter.
    """
    rng = np.random.default_rng(seed)
    shape = set_point_rad_s.shape
    command, measured = np.empty(shape), np.empty(shape)
    speed, seen = set_point_rad_s[0].copy(), np.empty(shape)
    sum_of_errors = (VISCOUS + DRAG * speed) * speed
    answer = sum_of_errors.copy()
    for k in range(shape[0]):
        measured[k] = speed + noise_rad_s * rng.normal(size=shape[1])
        seen[k] = measured[k] if k == 0 else smoothing * seen[k - 1] + (1.0 - smoothing) * measured[k]
        if k % every == 0:
            error = set_point_rad_s[k] - seen[max(k - delay, 0)]
            sum_of_errors = np.clip(sum_of_errors + integral_per_s * STEP_S * every * error, 0.0, 100.0)
            answer = np.clip(proportional * error + sum_of_errors, 0.0, 100.0)
        command[k] = answer
        speed = moved(speed, command[k])
    return Run("controlled", STEP_S * np.arange(float(shape[0])), command, measured)


def open_loop_commands(samples: int, fans: int) -> dict[str, Array]:
    """(samples, fans) commands given from outside, each kind predictable from its past in another way."""
    rng = np.random.default_rng(12)
    stairs = fan_data.stairs(rng, samples, fans)
    t_s = np.arange(samples)[:, None] * STEP_S
    frequency_hz, phase = rng.uniform(0.05, 0.5, (2, 1, fans)), rng.uniform(0.0, 2.0 * np.pi, (2, 1, fans))
    waves = np.sin(2.0 * np.pi * frequency_hz * t_s + phase)
    slewed, noise = stairs.copy(), rng.normal(size=stairs.shape)
    for k in range(1, samples):
        slewed[k] = slewed[k - 1] + np.clip(stairs[k] - slewed[k - 1], -2.0, 2.0)
        noise[k] += 0.98 * noise[k - 1]
    return {
        "stairs": stairs,
        "two rounded sines": np.round(50.0 + 20.0 * waves.sum(axis=0), 1),
        "ramps": slewed,
        "coloured noise": np.clip(50.0 + 4.0 * noise, 0.0, 100.0),
        "stairs with dither": stairs + rng.normal(size=stairs.shape),
    }


@pytest.mark.slow
def test_the_published_and_the_rough_fan_are_never_warned_about_but_for_a_lag() -> None:
    lines = [line for make in (published_run, rough_run) for line in warnings_of(make(3, duration_s=20.0, fans=4))]
    # One fan in a hundred without a lag comes out with one, below the sampling step; the warning says so.
    assert [line for line in lines if "lag_s" not in line] == []
    assert len(lines) <= 1


def test_settled_speeds_determine_the_drag_but_not_the_inertia() -> None:
    levels = [commanded(np.full((1500, 1), level), seed=1, warm_up_s=5.0) for level in (10.0, 40.0, 70.0, 100.0)]
    lines = warnings_of(*levels)
    assert has_line_with(lines, "little excitation: the command changes 0 time(s) only")
    assert has_line_with(lines, "J is poorly determined", "transients alone")
    assert not has_line_with(lines, "cannot be distinguished")


def test_commands_from_outside_are_called_a_loop_less_than_twice_in_a_hundred() -> None:
    kinds = open_loop_commands(1500, 60)
    run = commanded(np.hstack(list(kinds.values())), seed=2, noise_rad_s=0.1)
    raised = np.array([feedback_share([run], fan) > 0.0 for fan in range(run.fans)])
    false_alarms = dict(zip(kinds, raised.reshape(len(kinds), -1).mean(axis=1), strict=True))
    assert all(share < 0.02 for share in false_alarms.values()), false_alarms


@pytest.mark.parametrize(
    ("set_points", "controller"),
    [
        ("one", {"proportional": 1.0, "integral_per_s": 0.0}),
        ("one", {"every": 10}),
        ("one", {"smoothing": 0.9, "noise_rad_s": 0.05}),
        ("several", {"delay": 3}),
    ],
    ids=str,
)
def test_every_loop_is_noticed_also_behind_steps_of_its_set_point(set_points: str, controller: dict[str, Any]) -> None:
    stairs = fan_data.stairs(np.random.default_rng(6), 3000, 8, 60.0, 180.0)
    run = controlled(np.full((2000, 8), 120.0) if set_points == "one" else stairs, seed=3, **controller)
    assert all(feedback_share([run], fan) > 0.0 for fan in range(run.fans))


def test_a_loop_at_one_set_point_tells_one_operating_point_and_no_parameters() -> None:
    with pytest.raises(TwinError) as refused:
        identify([controlled(np.full((4000, 4), 120.0), seed=5)])
    said = re.fullmatch(
        r"fan 0: closed loop at one set-point: .* so J, alpha and C_D cannot be known, only that command (\S+) gives "
        r"(\S+) rad/s; record several set-points over the range, or steps of the command .*",
        str(refused.value),
    )
    assert said and float(said[2]) == pytest.approx(120.0, rel=0.01)
    assert float(said[1]) == pytest.approx((VISCOUS + DRAG * 120.0) * 120.0, rel=0.01)


def test_fans_whose_command_answers_their_speed_are_known_and_identified_as_well_as_in_open_loop() -> None:
    fans = plain_fans(3, seed=7)
    runs = runs_of(list(LOOPS), fans, 300.0, 10.0, seed=11)
    closed = {loop: [feedback_share([run], fan) > 0.0 for fan in range(run.fans)] for loop, run in runs.items()}
    assert closed == {loop: [loop in ANSWER_THE_SPEED] * 3 for loop in LOOPS}
    for loop in ("open", "PI fast", "PI slow", "current limit"):
        found = identify([runs[loop]])
        error, true = found.parameters[:, :3] - true_parameters(fans), true_parameters(fans)
        assert np.all(np.abs(error) < 3.0 * found.standard_errors[:, :3] + 0.02 * true), loop  # the air of that day
        assert np.abs(np.median(error[:, 0] / true[:, 0])) < 0.02, loop
        assert list(found.closed_loop) == closed[loop]
        assert not has_line_with(found.warnings, "closed loop")


@pytest.mark.parametrize(
    ("name", "estimate", "words"),
    [
        ("C_D", (-0.0025, 0.0005), ("fan 0: C_D is negative (-0.0025 ± 0.001)", "friction, dead zone or offset")),
        ("C_D", (-0.0025, 0.002), ("fan 0: C_D is not distinguishable from zero", "higher speed")),
        ("alpha", (0.012, 0.007), ("fan 0: alpha is not distinguishable from zero", "low speed")),
        ("J", (0.15, 0.05), ("fan 0: J is poorly determined (0.15 ± 0.1)",)),
        ("lag_s", (0.006, 0.001), ("fan 0: lag_s (6 ± 2 ms) is not determined by samples every 10 ms",)),
        ("lag_s", (0.03, 0.02), ("lag_s (30 ± 40 ms) is not determined",)),
        ("lag_s", (0.03, 0.002), ()),
    ],
)
def test_each_parameter_is_judged_by_its_own_interval(
    name: str, estimate: tuple[float, float], words: tuple[str, ...]
) -> None:
    """Published estimates with small errors, but for one."""
    estimates = {"J": (0.15, 0.001), "alpha": (0.012, 0.001), "C_D": (0.0025, 1e-5), "lag_s": (0.0, 0.0)}
    parameters, errors = np.array([(estimates | {name: estimate})[each] for each in PARAMETER_NAMES]).T
    lines = identifiability_warnings([published_run(1)], parameters[None], np.diag(errors**2)[None])
    assert len(lines) == bool(words)
    assert not words or has_line_with(lines, *words)


def test_a_command_that_hardly_moves_is_little_excitation() -> None:
    levels = np.random.default_rng(4).choice([50.0, 51.0], 14).repeat(100)[:, None]
    lines = warnings_of(commanded(levels, seed=4, warm_up_s=4.0))
    for reason in ("moves by 2.0%", "2 level(s) only", "hardly more than its noise"):
        assert has_line_with(lines, "little excitation", reason, "three or more levels")


def counted(gain_per_rad_s: float) -> Run:
    """Five minutes of a fan at 100 Hz that is read by counts over a second, under a thermostat ten times a second.

    A disturbance moves the speed, which a controller counters with this gain.
    """
    rng, tacho = np.random.default_rng(4), Tacho(kind="count", window_s=1.0)
    commands, readings, speed, reading, count = [], [], 100.0, 100.0, []
    wanted = warm = disturbed = 0.0
    for k in range(30_000):
        if k % 2000 == 0:
            wanted = rng.uniform(-40.0, 40.0)
        if k % 10 == 0:
            warm += 0.02 * (wanted - warm) + 0.02 * rng.normal()
        command = 100.0 + warm - gain_per_rad_s * (reading - 100.0 - warm)
        disturbed += 0.3 * rng.normal() - 0.005 * disturbed
        speed += 0.01 * (command + disturbed - speed)
        count.append(speed)
        if len(count) == 100:
            reading, count = tacho.resolution_rad_s * np.rint(np.mean(count) / tacho.resolution_rad_s), []
        commands.append([command])
        readings.append([reading])
    return Run("counted", 0.01 * np.arange(30_000.0), np.array(commands), np.array(readings), (tacho,))


def test_a_loop_through_a_tacho_that_counts_is_noticed_and_none_where_there_is_none() -> None:
    assert feedback_share([counted(0.5)], 0) > 0.2
    assert feedback_share([counted(0.0)], 0) == 0.0


def test_a_narrow_range_of_speed_determines_only_the_sum_of_alpha_and_drag() -> None:
    stairs = fan_data.stairs(np.random.default_rng(9), 4500, 4, 50.0, 70.0)
    apart = [
        line for line in warnings_of(commanded(stairs, seed=1, warm_up_s=5.0)) if "cannot be distinguished" in line
    ]
    assert len(apart) == 4
    for line in apart:
        value, error, speed = (float(part.split()[0]) for part in re.split(" = | ± ", line)[1:])
        assert abs(value - (VISCOUS + DRAG * speed)) < 2.0 * error
        assert 130.0 < speed < 170.0
