"""The sigma of scored residuals: it is made of the residual that the runtime computes."""

from dataclasses import replace

import numpy as np

from fantwin.schemas.standstill import Standstill
from fantwin.schemas.tacho import Tacho
from fantwin.scoring.expected_reading import ExpectedReading
from fantwin.twin.evaluation.accuracy import free_run_speeds
from fantwin.twin.evaluation.reading_range import reading_sigma_rad_s
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.runs import Run
from tests.support import fan_data

TACHO = Tacho(kind="count", window_s=0.5)
PERIOD_S = 0.1
PARAMETERS = np.array([[*fan_data.PUBLISHED_PARAMETERS, 0.0]])
WHOLE_SIGMA = np.array([9.0])
STANDSTILL = Standstill(turning_command=10.0, standing_below_rad_s=5.0, off_command=0.0, start_s=1.0)


def counted() -> Run:
    run = fan_data.counted_run(1, TACHO, 60.0)
    t_s = np.arange(run.samples) * PERIOD_S
    return replace(run, t_s=t_s, command=np.maximum(run.command, 10.0))


def runtime_residual(run: Run) -> np.ndarray:
    reading = ExpectedReading(run.tacho, PERIOD_S)
    speed = free_run_speeds(PhysicalModel(), PARAMETERS, run)
    reading.start(np.array([True]), speed[0])
    middle, half_range = reading.update(speed)
    residual = run.speed_rad_s - middle
    return np.asarray(residual - residual.clip(-half_range, half_range))[:, 0]


def sigma(run: Run, standstill: Standstill | None) -> float:
    return float(reading_sigma_rad_s(PhysicalModel(), PARAMETERS, WHOLE_SIGMA, standstill, [run])[0])


def test_it_is_that_of_the_residual_that_the_runtime_computes() -> None:
    run = counted()
    settled = run.t_s >= 3.0 + TACHO.reach_s
    residual = runtime_residual(run)[settled]
    assert abs(sigma(run, None) / np.sqrt(np.nanmean(residual**2)) - 1.0) < 0.02


def test_a_fan_that_stands_or_starts_does_not_count() -> None:
    run = counted()
    command = run.command.copy()
    command[300:350] = 0.0
    stopped = replace(run, command=command)
    assert sigma(stopped, STANDSTILL) < 0.2 * sigma(stopped, None)
    never = replace(run, command=np.zeros_like(run.command))
    assert sigma(never, STANDSTILL) == WHOLE_SIGMA[0], "that of the whole residual where no sample is left"
