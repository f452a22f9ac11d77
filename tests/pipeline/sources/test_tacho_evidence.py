"""Tachos found from readings: by how finely they are graded and how often they change."""

import numpy as np
import pytest

from fantwin.pipeline.sources.tacho_evidence import RAD_S_PER_RPM, find_tacho, tacho_hints
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho


def readings(tacho: Tacho, rate_hz: float, duration_s: float = 300.0, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """A fan whose speed wanders between 600 and 2,000 rpm, as its tacho prints it; one sample in fifty is missing."""
    rng = np.random.default_rng(seed)
    fine_s = np.arange(0.0, duration_s, 0.01)
    phases = rng.uniform(0.0, 2.0 * np.pi, 5)
    periods_s = np.array([7.0, 13.0, 29.0, 61.0, 97.0])
    speed = RAD_S_PER_RPM * (1300.0 + 140.0 * np.sin(2.0 * np.pi * fine_s[:, np.newaxis] / periods_s + phases).sum(1))
    turned = np.cumsum(speed) * 0.01
    t_s = np.arange(0.0, duration_s, 1.0 / rate_hz) + rng.uniform(0.0, 0.003, round(duration_s * rate_hz))
    if tacho.kind == "count":
        end_s = np.floor(t_s / tacho.held_s) * tacho.held_s
        pulses = [
            np.floor(np.interp(at, fine_s, turned) * tacho.pulses / (2.0 * np.pi))
            for at in (end_s, end_s - tacho.window_s)
        ]
        shown = (pulses[0] - pulses[1]) * tacho.resolution_rad_s
    else:
        shown = np.interp(t_s if not tacho.held_s else np.floor(t_s / tacho.held_s) * tacho.held_s, fine_s, speed)
    printed = RAD_S_PER_RPM * np.floor(shown / RAD_S_PER_RPM + 1e-6)
    printed[rng.uniform(size=len(t_s)) < 0.02] = np.nan
    return t_s, printed


@pytest.mark.parametrize(("window_s", "rate_hz"), [(0.5, 100.0), (0.75, 10.0), (1.0, 1.0)])
def test_a_count_is_found_at_any_rate_of_reports(window_s: float, rate_hz: float) -> None:
    found = find_tacho(*readings(Tacho(kind="count", window_s=window_s), rate_hz))
    assert found is not None
    assert found.tacho == Tacho(kind="count", window_s=window_s)
    if rate_hz * window_s > 2.0:
        assert found.change_s == pytest.approx(window_s, rel=0.01)


def test_a_window_that_slides_and_other_pulses_follow_from_the_time_between_changes() -> None:
    slides = Tacho(kind="count", window_s=1.0, update_s=0.25)
    found = find_tacho(*readings(slides, 50.0))
    assert found is not None
    assert found.tacho == slides
    one_pulse = find_tacho(*readings(Tacho(kind="count", window_s=1.0, pulses=1), 10.0))
    assert one_pulse is not None
    assert one_pulse.tacho == Tacho(kind="count", window_s=1.0, pulses=1)


@pytest.mark.parametrize(("rate_hz", "noise_rpm"), [(2.0, 0.0), (2.0, 3.0), (10.0, 0.0)])
def test_readings_that_are_held_are_found_without_grading(rate_hz: float, noise_rpm: float) -> None:
    """A drive that shows its speed once a second; polled twice a second, it was taken for instantaneous."""
    held = Tacho(kind="average", window_s=0.05, update_s=1.0)
    t_s, speed = readings(held, rate_hz)
    speed += noise_rpm * RAD_S_PER_RPM * np.random.default_rng(4).normal(size=400)[np.floor(t_s).astype(int)]
    found = find_tacho(t_s, speed)
    assert found is not None
    assert found.tacho == held
    assert tacho_hints(t_s, speed[:, np.newaxis], INSTANTANEOUS, [0]) == [
        "fan 0: readings change every 1.00 s only, and are not counts: shown for 1 s (`tacho = "
        '{ kind = "average", window_s = 0.05, update_s = 1.0 }` in [[tray]]; `window_s = 1` if they are means); '
        "declared is instantaneous"
    ]
    means = (Tacho(kind="average", window_s=1.0),)
    assert tacho_hints(t_s, speed[:, np.newaxis], means, [0]) == []


def test_slow_fans_reports_of_larger_changes_and_times_of_a_revolution_are_not_held_readings() -> None:
    t_s, printed = readings(Tacho(), 2.0)
    slow = RAD_S_PER_RPM * np.floor(1000.0 + 0.02 * (printed / RAD_S_PER_RPM - 1000.0))
    assert find_tacho(t_s, slow) is None
    fast_t_s, fast = readings(Tacho(), 20.0)
    reported = fast.copy()
    for row in range(1, len(fast)):
        if not abs(fast[row] - reported[row - 1]) >= 10.0 * RAD_S_PER_RPM:
            reported[row] = reported[row - 1]
    assert find_tacho(fast_t_s, reported) is None
    turns = readings(Tacho(kind="average", window_s=0.05, update_s=0.1), 50.0)
    assert find_tacho(turns[0], 0.1 * turns[1]) is None


def test_speeds_that_are_merely_printed_in_rpm_or_noisy_or_constant_speak_for_nothing() -> None:
    t_s, printed = readings(Tacho(), 20.0)
    assert find_tacho(t_s, printed) is None
    assert find_tacho(t_s, printed + np.random.default_rng(2).normal(0.0, 2.0, len(t_s))) is None
    assert find_tacho(t_s, np.full_like(t_s, 30.0 * RAD_S_PER_RPM)) is None
    assert find_tacho(t_s, np.full_like(t_s, np.nan)) is None


def test_noisy_readings_in_coarse_steps_that_no_count_could_make_speak_for_nothing() -> None:
    """A line that sends half rad/s, 100 times a second: as multiples of 4.77 rpm, of a count over 6.3 s."""
    t_s, printed = readings(Tacho(), 100.0)
    noisy = printed + np.random.default_rng(3).normal(0.0, 4.0, len(t_s))
    assert find_tacho(t_s, 0.5 * np.rint(noisy / 0.5)) is None
    assert find_tacho(*readings(Tacho(kind="count", window_s=1.0, update_s=0.01), 100.0)) is not None


def test_a_hint_names_the_fans_the_evidence_in_numbers_and_what_is_declared() -> None:
    t_s, slow = readings(Tacho(kind="count", window_s=1.0), 10.0)
    _, fast = readings(Tacho(kind="count", window_s=0.5), 10.0)
    speeds = np.column_stack([slow, slow, fast])
    assert tacho_hints(t_s, speeds, INSTANTANEOUS, [0, 1, 4]) == [
        "fans 0, 1: readings are multiples of 30 rpm and change every 1.00 s: a count over 1 s, 2 pulses a revolution "
        '(`tacho = { kind = "count", pulses = 2, window_s = 1.0 }` in [[tray]]); declared is instantaneous',
        "fan 4: readings are multiples of 60 rpm and change every 0.50 s: a count over 0.5 s, 2 pulses a revolution "
        '(`tacho = { kind = "count", pulses = 2, window_s = 0.5 }` in [[tray]]); declared is instantaneous',
    ]
    declared = tuple(Tacho(kind="count", window_s=window_s) for window_s in (1.0, 1.0, 0.5))
    assert tacho_hints(t_s, speeds, declared, range(3)) == []
