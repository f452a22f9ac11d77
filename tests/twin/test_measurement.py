"""The expected readings of a tacho against its definition, by brute force."""

import numpy as np
import pytest

from fantwin.schemas.tacho import Tacho
from fantwin.scoring.expected_reading import AveragedCommand
from fantwin.twin.measurement import Measurement

SLOW = Tacho(kind="count", window_s=1.0)
TACHOS = [
    SLOW,
    Tacho(kind="count", window_s=0.5, update_s=0.1, delay_s=0.07),
    Tacho(kind="average", window_s=0.4, update_s=1.5, step_rad_s=0.1),
    Tacho(delay_s=0.3),
    Tacho(),
]


def uneven_times(samples: int, signals: int) -> np.ndarray:
    steps = np.random.default_rng(3).uniform(0.02, 0.18, (samples, signals))
    return 5.0 + np.cumsum(steps, axis=0)


def mean_reading(tacho: Tacho, t_s: float, times: np.ndarray, signal: np.ndarray, held: bool) -> float:
    """The mean over many ages and many instants of the window."""
    fine = (np.arange(400) + 0.5) / 400
    at_s = t_s - tacho.delay_s - np.add.outer(tacho.held_s * fine, tacho.window_s * fine)
    if held:
        return float(signal[np.maximum(np.searchsorted(times, at_s, side="right") - 1, 0)].mean())
    return float(np.interp(at_s, times, signal).mean())


@pytest.mark.parametrize("held", [False, True], ids=["speed", "command"])
def test_the_expected_reading_is_the_mean_over_window_and_age(held: bool) -> None:
    times = uneven_times(80, len(TACHOS))
    signals = 200.0 + 50.0 * np.random.default_rng(4).standard_normal(times.shape).cumsum(axis=0)
    measurement = Measurement(times, TACHOS)
    shown = measurement.of_command(signals) if held else measurement.of_speed(signals)
    for column, tacho in enumerate(TACHOS[:4]):
        # Also where the window reaches before the first sample, whose value then counts as constant.
        for k in (0, 3, 15, 40, 78):
            ends = (k, k + 1) if held else (k,)
            at_ends = [mean_reading(tacho, times[i, column], times[:, column], signals[:, column], held) for i in ends]
            assert shown[k, column] == pytest.approx(np.mean(at_ends), abs=0.3 if held else 0.01)


@pytest.mark.parametrize("tacho", TACHOS[:2], ids=str)
def test_the_runtime_averages_commands_as_the_maker_does(tacho: Tacho) -> None:
    period_s = 0.1
    command = np.repeat(np.random.default_rng(7).uniform(0.0, 100.0, 60), 10)[:, np.newaxis]
    measurement = Measurement(period_s * np.arange(len(command), dtype=np.float64)[:, np.newaxis], [tacho])
    of_runtime = AveragedCommand([tacho], period_s).update(command)
    both = np.isfinite(of_runtime) & measurement.comparable
    assert np.count_nonzero(both) > 550
    expected = measurement.of_command(command)[both]
    # The maker holds commands, the runtime takes them as linear between samples, half a sample earlier.
    assert np.std(of_runtime[both] - expected) < 0.02 * np.std(expected)
