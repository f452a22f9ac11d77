"""From the pins to an alarm: the firmware in its simulator, in real time, on a serial line to the whole chain.

A rotor is blocked. The trace of the pins is the truth: what was recorded must be what was on them, and the delay of the
alarm counts from the moment at which the trace shows the block.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.recordings.reading import read_recording
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm, Array, Raw
from fantwin.schemas.units import NS_PER_S
from fantwin.schemas.wire import CommandFrame, encode
from tests.support.fan_board import FANS
from tests.support.fantwin_command import as_typed
from tests.support.firmware_build import FIRMWARE, firmware_file, simulator_file
from tests.support.make_board_twin import BOARD_TWIN
from tests.support.pin_trace import PinTrace, read_pin_trace
from tests.support.running_chain import DEADLINE_S, SITE, Chain, eventually, published, view_of

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

FAN, DUTY = 2, 0.7
CATCHES_UP_S = 0.3
"""behind real time, from which on its clock runs so fast afterwards that samples are behind the grid"""
LONGEST_DELAY_S = 1.5


class SimulatedBoard:
    """The simulator in real time, its serial line behind a link."""

    def __init__(self, link: Path, trace: Path) -> None:
        words = [str(simulator_file()), str(firmware_file()), "--link", str(link), "--vcd", str(trace)]
        self.process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    def order(self, line: str) -> None:
        assert self.process.stdin and self.process.stdout
        self.process.stdin.write(f"{line}\n".encode())
        self.process.stdin.flush()
        assert self.process.stdout.readline() == b"ok\n"

    def end(self) -> str:
        """Switch off; returns what the simulator said of its pace."""
        self.process.terminate()
        return self.process.communicate(timeout=DEADLINE_S)[1].decode()


@pytest.fixture
def board(tmp_path: Path) -> Iterator[SimulatedBoard]:
    board = SimulatedBoard(tmp_path / "tray", tmp_path / "pins.vcd")
    try:
        yield board
    finally:
        board.process.kill()


@pytest.fixture
def chain(tmp_path: Path, endpoint: str) -> Iterator[Chain]:
    settings = (f"site='{SITE}'", f"tray.0.twin='{BOARD_TWIN}'")
    quick = ("twin_integrator.warm_up_s=2",)
    with closing(Chain(tmp_path, endpoint, *settings, *quick, configuration=FIRMWARE / "fantwin.toml")) as chain:
        yield chain


def test_a_blocked_rotor_on_the_pins_is_an_alarm(board: SimulatedBoard, chain: Chain, tmp_path: Path) -> None:
    assert board.process.stderr
    ready = f"simulator: ready: the serial line of the board is {tmp_path / 'tray'}; settings and faults on "
    assert board.process.stderr.readline().decode().startswith(ready)
    up = chain.start_up()
    with chain.watcher() as watcher:
        eventually(lambda: published(view_of(watcher, "scorer")) > 0, "scores flow")
        moved = as_typed(*chain.words("command"), "--fan", FAN, DUTY)
        assert moved.returncode == 0, moved.stderr
        scored = published(view_of(watcher, "scorer"))
        board.order(f"send {spoilt_frame().hex()}")
        eventually(lambda: published(view_of(watcher, "scorer")) > scored + 150, "the baseline is complete")
        board.order(f"block {FAN}")
        eventually(watcher.current_alarms, "an alarm is raised")
    code = up.end()
    outcome = up.output()
    pace = board.end()
    trace = read_pin_trace(tmp_path / "pins.vcd", FANS)
    messages = [envelope.message for path in chain.recordings() for envelope in read_recording(path)]
    raws = [message for message in messages if isinstance(message, Raw)]
    alarms = [message for message in messages if isinstance(message, Alarm)]

    # By the clock of the board. A busy machine lets it fall behind the host, and the times of samples are as wrong.
    behind = re.search(r"at most ([0-9.]+) s behind real time", pace)
    assert behind, pace
    behind_s = float(behind[1])
    (counted,) = outcome["refused"].values()
    assert counted["device_bad_crc"] == 1, "as the board has counted"
    if behind_s < CATCHES_UP_S:
        assert (code, any(outcome["lost"].values()), len(counted)) == (0, False, 1), (outcome["lost"], counted)
    clock_s = np.concatenate([raw.device_clock_us for raw in raws]) / 1e6
    check_that_the_pins_were_recorded(trace, clock_s, raws)
    raised = [alarm for alarm in alarms if alarm.transition == Transition.RAISED]
    if behind_s < CATCHES_UP_S:
        assert {alarm.fan for alarm in raised} == {FAN}, ([alarm.message for alarm in raised], pace)
    raised = [alarm for alarm in raised if alarm.fan == FAN]
    received_s = np.concatenate([raw.host_receive_t_ns for raw in raws]) / NS_PER_S
    blocked_s = trace.blocked_s[FAN][0]
    delay_s = np.interp(raised[0].t_ns / NS_PER_S, received_s, clock_s) - blocked_s
    assert -behind_s < delay_s < LONGEST_DELAY_S + behind_s, pace
    print(f"blocked at {blocked_s:.3f} s of the trace, alarm {delay_s:.3f} s later; {pace}")


def spoilt_frame() -> bytes:
    """Command frames damaged by noise on the line."""
    frame = bytearray(encode("binary", CommandFrame((0.5,) * FANS)))
    frame[-3] ^= 3
    return bytes(frame)


def check_that_the_pins_were_recorded(trace: PinTrace, clock_s: Array, raws: list[Raw]) -> None:
    """Each recorded speed is that of the edges on the pin, each command the duty, and the supply is there."""
    command, speed_rad_s, supply_v = (
        np.concatenate([getattr(raw, column) for raw in raws])
        for column in ("command", "speed_rad_s", "supply_voltage_v")
    )
    assert np.abs(supply_v - 11.85).max() < 0.02 * 12.0
    assert command[-1, FAN] == pytest.approx(DUTY, abs=1 / 640)
    for fan in range(FANS):
        # A pulse counts after 100 us without noise, and at the moment of a sample one may just be on its way.
        on_pins = np.stack([trace.speed_rad_s(fan, clock_s - late_s) for late_s in (0.0, 150e-6)])
        turns = np.isfinite(on_pins).all(axis=0) & (speed_rad_s[:, fan] > 0.0)
        if fan == FAN:
            turns &= clock_s < trace.blocked_s[fan][0]
        assert turns.sum() > 200
        errors = np.abs(speed_rad_s[:, fan] / on_pins - 1.0).min(axis=0)[turns]
        assert errors.max() < 2e-3, fan
        # The pin follows the sample by less than a millisecond; one step in 80 shows as a mean over eight of these.
        assert np.abs(command[:, fan] - trace.duty_at(fan, clock_s + 3e-3)).max() < 1 / 80 + 1e-3, fan
