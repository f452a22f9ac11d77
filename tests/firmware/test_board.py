"""The firmware on a simulated ATmega328P with four rotors on its pins: what comes out of the pins and the line.

Time is simulated and faster than real. `truth` is the simulator's, samples are the firmware's own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from fantwin.schemas.channels import SUPPLY_VOLTAGE
from fantwin.schemas.units import RAD_S_PER_UNIT
from fantwin.schemas.wire import DEVICE_COUNTERS, CommandFrame, DeviceCounters, Sample, SetPointFrame, encode
from tests.support.fan_board import FANS, FanBoard
from tests.support.firmware_build import firmware_file, simulator_file

NAN = math.nan
RATE_HZ, PWM_HZ, STEP_OF_DUTY = 50, 25_000, 1 / 640
Boards = Callable[..., FanBoard]


@pytest.fixture
def boards() -> Iterator[Boards]:
    """Boards whose firmware is built with some settings."""
    started: list[FanBoard] = []

    def start(**settings: str | int) -> FanBoard:
        started.append(FanBoard(simulator_file(), firmware_file(**settings)))
        return started[-1]

    yield start
    for board in started:
        board.close()


@pytest.fixture
def board(boards: Boards) -> FanBoard:
    return boards()


def speeds(samples: list[Sample]) -> np.ndarray:
    """(samples, fans) rpm."""
    return np.array([sample.speed for sample in samples])


def test_it_starts_at_full_speed_and_samples_at_an_even_pace(board: FanBoard) -> None:
    samples = board.run(2.01)  # the last one needs time for the line
    assert not board.faults
    assert [sample.sequence for sample in samples] == list(range(2 * RATE_HZ))
    steps_us = np.diff([sample.clock_us or 0 for sample in samples])
    assert steps_us.mean() == pytest.approx(1e6 / RATE_HZ, abs=1.0)
    assert np.abs(steps_us - 1e6 / RATE_HZ).max() < 200
    assert all(sample.command == (1.0,) * FANS for sample in samples)
    assert all(math.isnan(speed) for speed in samples[0].speed)
    assert [fan.duty for fan in board.truth().fans] == [1.0] * FANS
    assert board.truth().counters == dict.fromkeys(board.truth().counters, 0)
    assert board.counters == [DeviceCounters(second, (0,) * len(DEVICE_COUNTERS)) for second in (0, 1)]


def test_a_command_moves_the_pwm_and_the_sample_tells_since_when(board: FanBoard) -> None:
    board.run(0.5)
    wanted = (0.25, 0.5037, 0.75, 0.3)
    board.command(*wanted)
    samples = board.run(0.1)
    changes = [i for i, sample in enumerate(samples) if sample.command != (1.0,) * FANS]
    assert 0 < changes[0] <= 2  # bytes take 2 ms, then the next sample
    reported = samples[-1].command
    assert reported == pytest.approx(wanted, abs=0.5 * STEP_OF_DUTY + 1e-9)
    # Fans 2 and 3 have 80 steps, and finer ones in the mean over 8 ms: 0.3 is one between.
    means = np.zeros(FANS)
    for _ in range(80):
        board.run(0.001)
        means += [fan.duty / 80 for fan in board.truth().fans]
    assert means == pytest.approx(reported, abs=1e-3)
    board.command(0.0, NAN, 0.0, NAN)
    board.run(0.1)
    assert [fan.duty for fan in board.truth().fans] == pytest.approx((0.0, reported[1], 0.0, reported[3]), abs=1 / 80)


def test_the_pwm_has_25_khz_on_all_four_pins(board: FanBoard) -> None:
    board.run(0.1)
    board.command(0.5)
    board.run(0.1)
    before = board.truth()
    board.run(1.0)
    after = board.truth()
    assert [fan.pwm_hz for fan in after.fans] == [PWM_HZ] * FANS
    periods = [now.pwm_periods - then.pwm_periods for now, then in zip(after.fans, before.fans, strict=True)]
    assert periods[2:] == pytest.approx([PWM_HZ] * 2, abs=2)


@pytest.mark.parametrize("speed_rpm", [150.0, 12_000.0])
def test_the_time_of_a_revolution_is_measured_to_microseconds(board: FanBoard, speed_rpm: float) -> None:
    for fan in range(FANS):
        board.order("hold", fan, speed_rpm + fan)
    board.run(2.0)
    samples = speeds(board.run(2.0))
    for fan in range(FANS):
        true = speed_rpm + fan
        errors_us = 60e6 / samples[:, fan] - 60e6 / true
        # A microsecond of resolution at both ends, and interrupts that wait for one another.
        assert np.abs(errors_us).max() < 12.0
        assert errors_us.std() < 5.0


def test_pulses_are_counted_over_a_window(boards: Boards) -> None:
    board = boards(MEASURE="count", WINDOW_MS=500)
    for fan in range(FANS):
        board.order("hold", fan, 1000 + 500 * fan)
    samples = speeds(board.run(4.0))
    assert np.isnan(samples[: RATE_HZ // 2 - 1]).all()
    known = samples[RATE_HZ // 2 + 1 :]
    resolution_rpm = 60 / (2 * 0.5)
    assert np.array_equal(known, np.round(known / resolution_rpm) * resolution_rpm)
    assert np.abs(known - [1000, 1500, 2000, 2500]).max() <= resolution_rpm
    assert all(len(np.flatnonzero(np.diff(known[:, fan]))) <= 7 for fan in range(FANS))  # one value a window


def test_noise_on_the_tachos_is_filtered_and_counted(board: FanBoard) -> None:
    for fan in range(FANS):
        board.order("hold", fan, 3000)
        board.order("noise", fan, 20)
    board.run(2.0)
    samples = speeds(board.run(2.0))
    # A short pulse may hide an edge until it has passed: the edge is late by that, and no more.
    assert np.abs(60e6 / samples - 60e6 / 3000).max() < 200
    counted = board.truth().counters["glitches"]
    assert counted > 1000
    sent = [counters.counts[DEVICE_COUNTERS.index("glitches")] for counters in board.counters]
    assert 0.5 * counted < sent[-1] <= counted, "the last frame is up to a second old"


def test_a_blocked_rotor_reads_zero_within_the_time_of_standing(board: FanBoard) -> None:
    board.run(3.0)
    board.order("block", 2)
    samples = speeds(board.run(1.0))
    stands = np.flatnonzero(samples[:, 2] == 0.0)
    assert stands[0] / RATE_HZ < 0.5 + 0.15 + 2 / RATE_HZ  # after the last pulse, which comes as the rotor stops
    assert (samples[:, [0, 1, 3]] > 8000).all()
    assert (np.diff(samples[: stands[0], 2]) <= 1.0).all()  # falls without a jump back


def test_set_points_are_held_against_a_change_of_drag_and_supply(board: FanBoard) -> None:
    wanted = np.array([3000.0, 4000.0, 5000.0, 6000.0])
    board.run(3.0)
    board.send(SetPointFrame(tuple(wanted)))
    board.run(8.0)
    assert speeds(board.run(1.0)).mean(axis=0) == pytest.approx(wanted, rel=0.01)
    duty = board.samples[-1].command
    board.order("drag", 1, 1.5)
    board.order("supply", 11)
    board.run(8.0)
    assert speeds(board.run(1.0)).mean(axis=0) == pytest.approx(wanted, rel=0.01)
    assert all(now > then for now, then in zip(board.samples[-1].command, duty, strict=True))
    board.command(0.5, NAN, NAN, NAN)
    last = board.run(0.1)[-1]
    assert last.command[0] == 0.5
    assert last.speed[1] == pytest.approx(wanted[1], rel=0.01)


def test_a_silent_host_means_full_speed_until_it_speaks_again(boards: Boards) -> None:
    board = boards(HOST_SILENCE_S=2)
    board.run(3.0)
    board.command(0.3)
    board.run(1.9)
    board.send(CommandFrame((NAN,) * FANS))  # says nothing but that it is there
    assert all(sample.command[0] == pytest.approx(0.3) for sample in board.run(1.9)[3:])
    assert board.run(0.2)[-1].command == (1.0,) * FANS
    assert board.truth().counters["host_silences"] == 1
    board.send(SetPointFrame((4000.0, NAN, NAN, NAN)))
    assert board.run(0.3)[-1].command[1:] == (1.0,) * (FANS - 1)
    assert board.samples[-1].command[0] < 1.0


def test_what_is_no_frame_changes_nothing_and_is_counted(board: FanBoard) -> None:
    board.run(0.1)
    board.command(0.4)
    board.run(0.2)
    good = encode("binary", CommandFrame((0.9,) * FANS))
    rng = np.random.default_rng(1)
    flipped = [bytearray(good) for _ in range(20)]
    for frame in flipped:
        frame[rng.integers(1, len(frame) - 1)] ^= 1 << rng.integers(0, 8)
    for frame in flipped:
        board.order("send", bytes(frame).hex())
        board.run(0.05)
    board.order("send", rng.bytes(1500).hex())
    board.order("send-broken", good.hex())
    board.run(0.5)
    board.order("send", (b"\0" + encode("binary", CommandFrame((2.0,) * FANS))).hex())
    board.run(0.2)
    reported, counted = board.samples[-1].command, board.truth().counters
    assert counted["line_errors"] == len(good)
    assert counted["bad_value"] == 1
    assert counted["bad_crc"] + counted["bad_length"] + counted["wrong_kind"] >= 20
    assert counted["frames"] == 2  # the first, and the one whose bytes all came with framing errors, but whole
    assert reported == pytest.approx((0.9,) * FANS, abs=STEP_OF_DUTY)
    board.run(1.1)
    assert board.counters[-1].counts == tuple(counted.values()), "the host is sent what the board has counted"


@pytest.mark.parametrize(("supply_v", "chip_v"), [(10.5, 5.0), (13.2, 4.6)])
def test_the_supply_is_measured_within_2_percent(board: FanBoard, supply_v: float, chip_v: float) -> None:
    board.order("supply", supply_v)
    board.order("chip-supply", chip_v)
    board.run(0.1)
    board.command(0.5)
    samples = board.run(1.0)[10:]
    measured = np.array([sample.measured[SUPPLY_VOLTAGE] for sample in samples])
    assert np.abs(measured / board.truth().supply_v - 1.0).max() < 0.02


def test_the_watchdog_of_the_chip_restarts_it_at_full_speed(board: FanBoard) -> None:
    board.run(0.1)
    board.command(0.3)
    board.run(1.0)
    board.order("hang")
    samples = board.run(1.0)
    assert board.truth().restarts == 1
    assert board.truth().counters["watchdog_resets"] == 1
    assert (samples[0].sequence, samples[-1].command) == (0, (1.0,) * FANS)
    assert len(samples) >= 0.7 * RATE_HZ
    assert board.counters[-1] == DeviceCounters(0, (0,) * (len(DEVICE_COUNTERS) - 1) + (1,))
    assert samples[-1].speed == pytest.approx(
        [fan.speed_rad_s / RAD_S_PER_UNIT["rpm"] for fan in board.truth().fans], rel=0.05
    )


def test_without_the_supply_it_sends_plain_samples_and_no_sample_is_lost_at_100_hz(boards: Boards) -> None:
    board = boards(SUPPLY=0, RATE_HZ=100)
    samples = board.run(2.01)
    assert len(samples) == 200
    assert samples[-1].measured == {}
    fast = boards(RATE_HZ=100)
    assert len(fast.run(2.01)) == 200
    assert fast.truth().counters["unsent_samples"] == 0
