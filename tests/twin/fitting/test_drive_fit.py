"""The drive of fans that control their own speed is found where there is one, and nowhere else."""

from dataclasses import replace

import numpy as np

from fantwin.schemas.tacho import INSTANTANEOUS
from fantwin.twin.fitting.drive_fit import MOST_ITERATIONS, FoundDrive, find_drive
from fantwin.twin.fitting.identification import identify
from fantwin.twin.fitting.standstill import find_standstill
from fantwin.twin.models.drive import Drive
from fantwin.twin.progress import Progress, unreported
from fantwin.twin.runs import Run
from tests.support.driven_fan import DRIVE, HOLD_S, SETTINGS, run_of

AGE_S = 4.0


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
    """Errors of an unknown age, as on a line that is slower than the fan, are far larger than what a drive explains."""
    runs = [of_unknown_age(run_of(DRIVE, seed), seed) for seed in (1, 2)]
    found = find_drive(runs[:1], runs[1:], identify(runs[:1]), find_standstill(runs))
    assert found is not None
    np.testing.assert_allclose(found.settings[:, 0], SETTINGS[:, 0], rtol=0.1)


def of_unknown_age(run: Run, seed: int) -> Run:
    age_s = np.random.default_rng(seed).uniform(-AGE_S, AGE_S, run.speed_rad_s.shape)
    slope = np.gradient(run.speed_rad_s, run.t_s, axis=0)
    return replace(run, speed_rad_s=np.maximum(run.speed_rad_s + age_s * slope, 0.0))
