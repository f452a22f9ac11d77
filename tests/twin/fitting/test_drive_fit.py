"""The drive of fans that control their own speed is found where there is one, and nowhere else."""

from dataclasses import replace

import numpy as np

from fantwin.schemas.tacho import INSTANTANEOUS, Tacho
from fantwin.twin.fitting.drive_fit import MOST_ITERATIONS, FoundDrive, find_drive
from fantwin.twin.fitting.identification import identify
from fantwin.twin.fitting.standstill import find_standstill
from fantwin.twin.measurement import measurement_of
from fantwin.twin.models.drive import Drive
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.progress import Progress, unreported
from fantwin.twin.runs import Run

DRIVE = Drive(turning_command=10.0, kick_s=0.6, rest_s=2.0)
PHYSICS = np.array([[0.35, 0.25, 5e-4, 0.0]])
SETTINGS = np.array([[50.0, 10.0, 180.0]])
RATE_HZ, HOLD_S = 10.0, 12.0
AGE_S = 4.0


def run_of(drive: Drive | None, seed: int) -> Run:
    """Eight minutes of a counted fan whose command jumps; every fifth one stops it."""
    rng = np.random.default_rng(seed)
    levels = rng.choice([20.0, 30.0, 45.0, 70.0, 110.0, 160.0, 220.0, 255.0], 40)
    levels[4::5] = 0.0
    command = np.repeat(levels, round(HOLD_S * RATE_HZ))[:, np.newaxis]
    t_s = np.arange(len(command)) / RATE_HZ
    model = PhysicalModel() if drive is None else PhysicalModel().with_drive(drive)
    parameters = PHYSICS if drive is None else np.hstack((PHYSICS, SETTINGS))
    state = model.state_layout.initial_state(np.array([100.0]), command[0])
    speed, _ = model.advance(state, command, np.full(len(t_s), 1.0 / RATE_HZ), parameters)
    run = Run("made", t_s, command, speed, (Tacho(kind="count", window_s=0.5),))
    noise = rng.normal(0.0, run.tacho[0].resolution_rad_s / np.sqrt(6.0), speed.shape)
    return replace(run, speed_rad_s=np.maximum(measurement_of(run).of_speed(speed) + noise, 0.0))


def found_in(drive: Drive | None, progress: Progress = unreported) -> FoundDrive | None:
    runs, held_out = [run_of(drive, 1)], [run_of(drive, 2)]
    return find_drive(runs, held_out, identify(runs), find_standstill([*runs, *held_out]), progress)


def test_plateau_friction_and_kick_are_found() -> None:
    reported: list[tuple[int, int]] = []
    drive = replace(DRIVE, kick_s=0.3)
    found = found_in(drive, lambda _part, done, at_most, _rmse: reported.append((done, at_most)))
    assert found is not None
    assert found.drive == drive
    np.testing.assert_allclose(found.settings, SETTINGS, rtol=0.05, atol=1.5)
    assert [done for done, _ in reported] == list(range(1, len(reported) + 1))
    assert {at_most for _, at_most in reported} == {MOST_ITERATIONS}
    assert len(reported) <= MOST_ITERATIONS


def test_a_drive_is_looked_for_where_readings_are_of_pulses_and_starts_are_many() -> None:
    run, standstill = run_of(DRIVE, 1), find_standstill([run_of(DRIVE, 1)])
    plain = identify([run_of(None, 1)])
    assert find_drive([replace(run, tacho=INSTANTANEOUS)], [], plain, standstill) is None
    assert find_drive([run.between(0.0, 3 * 5 * HOLD_S)], [], plain, standstill) is None


def test_a_fan_whose_command_acts_as_it_is_gets_no_drive() -> None:
    assert found_in(None) is None


def test_errors_of_readings_while_the_speed_changes_do_not_hide_a_drive() -> None:
    """Of unknown age, as on a line that is slower than the fan: they exceed all that a drive explains by far."""
    runs = [of_unknown_age(run_of(DRIVE, seed), seed) for seed in (1, 2)]
    found = find_drive(runs[:1], runs[1:], identify(runs[:1]), find_standstill(runs))
    assert found is not None
    np.testing.assert_allclose(found.settings[:, 0], SETTINGS[:, 0], rtol=0.1)


def of_unknown_age(run: Run, seed: int) -> Run:
    age_s = np.random.default_rng(seed).uniform(-AGE_S, AGE_S, run.speed_rad_s.shape)
    slope = np.gradient(run.speed_rad_s, run.t_s, axis=0)
    return replace(run, speed_rad_s=np.maximum(run.speed_rad_s + age_s * slope, 0.0))
