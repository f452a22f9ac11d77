"""Acquisition: input becomes raw samples or is counted by kind; commands go back to the device.

What its limits refuse is said in one short line that stays the same, with the setting to correct.
"""

from __future__ import annotations

import math
import random
import struct
import zlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from cobs import cobs

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.sources.serial.port import ReceivedBytes
from fantwin.pipeline.sources.source import LinkDown, LinkUp, Noted, Reading
from fantwin.pipeline.timebase.host_clock import HostClock
from fantwin.schemas.codec import decode
from fantwin.schemas.codec import encode as encode_message
from fantwin.schemas.messages import Command, Raw
from fantwin.schemas.units import NS_PER_S as S
from fantwin.schemas.wire import CommandFrame, Decoder, Frame, Protocol, Sample, SetPointFrame, encode
from fantwin.stages.acquisition import AcquisitionConfig
from tests.support.serial_core import FakeLink, SerialCore

PROTOCOLS: tuple[Protocol, ...] = ("binary", "text")


def make_core(link: FakeLink | None = None, block_s: float = 0.0, **tray: object) -> SerialCore:
    """A core of two fans, its line opened at time 0."""
    values: dict[str, object] = {"name": "bench", "fans": 2, "port": "/dev/ttyTEST"} | tray
    config = AcquisitionConfig(block_s=block_s)
    core = SerialCore(TrayConfig.model_validate(values), config, link or FakeLink())
    assert core.step(LinkUp()) == []
    return core


def sample(sequence: int | None, clock_us: int | None = None, speed: float = 100.0, command: float = 0.5) -> Sample:
    """A sample of two fans; the clock follows the sequence unless given."""
    if clock_us is None and sequence is not None:
        clock_us = sequence * 10_000 % 2**32
    return Sample(clock_us, sequence, (command, 0.25), (speed, 50.0))


def feed(core: SerialCore, frames: Iterable[Frame], protocol: Protocol = "binary", t_ns: int = S) -> list[Raw]:
    return [raw for frame in frames for raw in core.step(ReceivedBytes(encode(protocol, frame), t_ns))]


def feed_sequences(core: SerialCore, sequences: Iterable[int]) -> list[int]:
    """Feed samples with these sequence numbers; returns the numbers that came out."""
    return [int(raw.device_sequence[0]) for raw in feed(core, map(sample, sequences))]


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_sample_becomes_a_raw_message_with_both_clocks_and_its_speed_in_rad_per_second(protocol: Protocol) -> None:
    core = make_core(protocol=protocol, speed_unit="rpm")
    (raw,) = feed(core, [sample(7, clock_us=123, speed=60.0)], protocol, t_ns=5 * S)
    assert (raw.fans, raw.host_receive_t_ns.tolist()) == (2, [5 * S])
    assert (raw.device_clock_us.tolist(), raw.device_sequence.tolist()) == ([123], [7])
    assert raw.command.tolist() == [[0.5, 0.25]]
    assert raw.speed_rad_s[0] == pytest.approx([2 * math.pi, 2 * math.pi * 50 / 60], rel=1e-15)
    assert core.counters()["samples"] == 1


def test_a_device_without_clock_and_sequence_has_empty_columns_and_loses_nothing() -> None:
    core = make_core(protocol="text", block_s=0.05)
    frames = sample(None), sample(None), sample(5), sample(6), sample(7)
    messages = core.step(ReceivedBytes(b"".join(encode("text", frame) for frame in frames), S))
    assert [len(raw.host_receive_t_ns) for raw in messages] == [2, 3]
    assert [len(raw.device_sequence) for raw in messages] == [0, 3]
    assert [len(raw.device_clock_us) for raw in messages] == [0, 3]
    assert core.counters().get("lost_on_line", 0) == 0


@pytest.mark.parametrize("speed", [1001.0, -math.inf, math.nan])
def test_a_speed_that_is_absurd_or_missing_is_none_of_that_fan_only_and_is_counted(speed: float) -> None:
    core = make_core(speed_max=1000)
    (raw,) = feed(core, [sample(0, speed=speed)])
    assert np.isnan(raw.speed_rad_s).tolist() == [[True, False]]
    assert raw.command.tolist() == [[0.5, 0.25]]
    counts = core.counters()
    assert (counts.get("absurd_speed", 0), counts["no_speed"]) == ((0, 1) if math.isnan(speed) else (1, 0))


def test_an_absurd_command_removes_the_sample_and_shows_as_a_loss() -> None:
    core = make_core(command_max=0.9)
    frames = [sample(0), sample(1, command=0.91), sample(2)]
    assert [raw.device_sequence.tolist() for raw in feed(core, frames)] == [[0], [2]]
    assert core.counters()["absurd_command"] == core.counters()["refused_input"] == 1
    assert core.counters()["lost_on_line"] == 1
    assert core.counters().get("lost_refused", 0) == 0
    why = "command 0.91 is outside command_min = 0 to command_max = 0.9"
    assert core.notes() == [f"refused input: absurd_command 1, the first of them: {why}"]


def test_an_unknown_command_costs_its_own_fan_and_what_is_noted_is_said_with_how_often() -> None:
    core = make_core()
    counts, quality = core._counts, core._quality
    plausible = core._plausibility.plausible
    assert plausible(Reading((math.nan, 0.25), (100.0, 50.0))) == Reading((math.nan, 0.25), (100.0, 50.0))
    assert plausible(Reading((math.nan, math.nan), (100.0, 50.0))) is None
    assert (counts["fans_without_command"], counts["unknown_command"]) == (1, 1)
    for mode in (5, 2):
        assert plausible(Noted("taken_back", f"pwm1: mode {mode}")) is None
    assert core.notes()[-1] == "pwm1: mode 2 (taken_back 2)"
    assert quality._faulty == 1, "what is noted is no fault of the input"


@pytest.mark.parametrize("sequences", [range(50), [None] * 50], ids=["numbered", "unnumbered"])
def test_samples_refused_to_the_end_are_lost_though_no_gap_shows_them(sequences: Iterable[int | None]) -> None:
    core = make_core(protocol="text")
    feed(core, [sample(number, command=117) for number in sequences], "text")
    assert core.counters()["lost_refused"] == core.counters()["absurd_command"] == 50
    assert core.counters().get("samples", 0) == 0


def test_a_refused_sample_is_counted_as_lost_once_and_a_corrupt_number_is_not_believed() -> None:
    core, lost = make_core(command_max=0.9), []
    absurd = [sample(5, command=2.0), sample(2**31, command=2.0), sample(6, command=2.0)]
    for frame in [sample(4), *absurd, sample(8), Sample(0, 9, (0.5,), (1.0,)), sample(0)]:
        feed(core, [frame])
        lost.append(sum(count for name, count in core.counters().items() if name.startswith("lost_")))
    assert lost == [0, 1, 2, 3, 3, 4, 4], "what was refused before a restart of the device stays lost"
    assert core.counters()["device_restarts"] == 1


@pytest.mark.parametrize("last", [100, 4_000_000_000])
def test_a_device_restart_is_not_a_loss_of_four_billion(last: int) -> None:
    core = make_core()
    assert feed_sequences(core, [last, last + 1, 0, 1, 2]) == [last, last + 1, 0, 1, 2]
    assert core.counters()["device_restarts"] == 1
    assert core.counters().get("lost_on_line", 0) == 0


def test_samples_measured_while_the_line_was_down_are_counted_as_lost() -> None:
    core = make_core()
    feed_sequences(core, [0, 1, 2])
    core.step(ReceivedBytes(encode("binary", sample(3))[:20], S))
    core.step(LinkDown("gone"))
    core.step(LinkUp())
    core.step(ReceivedBytes(encode("binary", sample(7))[20:], S))
    assert feed_sequences(core, [8]) == [8]
    assert core.counters()["lost_on_line"] == 5
    assert core.counters()["resync"] == 1
    assert core.counters().get("truncated", 0) == 0


def test_a_frame_of_a_later_protocol_is_no_fault() -> None:
    core, payload = make_core(), b"\x01\x09later"
    later = b"\0" + cobs.encode(payload + struct.pack("<I", zlib.crc32(payload))) + b"\0"
    for number in range(100):
        feed(core, [sample(number)])
        core.step(ReceivedBytes(later * 3, S))
    counts = {name for name, count in core.counters().items() if count}
    assert (core.problem(), counts) == ("", {"bytes", "samples", "unknown_type", "line_up"})


def command(*values: float, set_point: tuple[float, ...] = (), fans: int = 2) -> Command:
    return Command(fans=fans, t_ns=S, command=np.array(values), set_point_rad_s=np.array(set_point))


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_commands_and_set_points_are_sent_in_the_unit_of_the_tray(protocol: Protocol) -> None:
    link = FakeLink()
    core = make_core(link, protocol=protocol, speed_unit="rpm")
    core.step(command(0.75, math.nan, set_point=(math.nan, 2 * math.pi)))
    found = Decoder(protocol, 2, "device").feed(link.written)
    assert [repr(frame) for frame in found] == [
        repr(CommandFrame((0.75, math.nan))),
        repr(SetPointFrame((math.nan, 60.0))),
    ]
    assert core.counters()["sent_commands"] == 1


@pytest.mark.parametrize(
    ("refused", "reason"),
    [
        (command(1.5, 0.5), "the command of fan 0 is 1.5, outside 0 to 1"),
        (command(0.5, -math.inf), "the command of fan 1 is -inf, outside 0 to 1"),
        (command(0.5, 0.5, set_point=(2e3, 0.0)), "the set-point of fan 0 is 2000 rad/s, outside -1000 to 1000 rad/s"),
        (command(0.5, fans=1), "it is for 1 fans, the tray has 2"),
    ],
)
def test_a_command_that_the_tray_cannot_carry_out_is_refused_as_a_whole_and_counted_with_the_reason(
    refused: Command, reason: str
) -> None:
    link = FakeLink()
    core = make_core(link, speed_max=1000)
    core.step(refused)
    assert core.notes() == [f"1 command refused: {reason}"]
    core.step(refused)
    assert link.written == b""
    assert core.counters()["refused_commands"] == 2
    assert core.notes() == [f"2 commands refused, the last one: {reason}"]


def test_a_command_that_was_not_written_is_lost_and_one_that_changes_nothing_is_not_sent() -> None:
    link = FakeLink()
    core = make_core(link)
    core.step(command(math.nan, math.nan))
    core.step(command())
    assert (link.written, dict(core.counters())) == (b"", {"line_up": 1})
    link.up = False
    core.step(command(0.5, 0.5))
    assert core.counters()["lost_commands"] == 1
    assert core.notes()[0].startswith("1 command not taken by the device: ")


def test_a_line_that_is_down_or_silent_for_two_seconds_is_a_problem_until_it_sends() -> None:
    core = make_core()
    for reason in ("no such port; waiting for it; check [[tray]] port", "not allowed"):
        core.step(LinkDown(reason))
        assert core.problem() == f"/dev/ttyTEST: {reason}"
    core.step(LinkUp())
    assert core.problem() == ""
    assert core.counters()["line_down"] == 1
    feed(core, [sample(0)], t_ns=S)
    core.tick(3 * S)
    assert core.problem() == ""
    core.tick(3 * S + 1)
    assert core.problem().startswith("/dev/ttyTEST: nothing received for 2 s; is the source running")
    feed(core, [sample(1)], t_ns=4 * S)
    assert core.problem() == ""


def test_the_silence_of_a_slow_line_is_judged_by_its_own_steps() -> None:
    core = make_core()
    core.step(LinkUp())
    for number in range(4):
        feed(core, [sample(number)], t_ns=15 * number * S)
    core.tick(80 * S)
    assert core.problem() == ""
    core.tick(90 * S)
    assert core.problem().startswith("/dev/ttyTEST: nothing received for 37.5 s; is the source running")


class SetClock:
    """A host whose wall clock is set."""

    def __init__(self) -> None:
        self.wall_ns = self.monotonic_ns = 0
        self.clock = HostClock(lambda: self.wall_ns, lambda: self.monotonic_ns)

    def passes(self, seconds: float, set_by_s: int = 0) -> int:
        self.monotonic_ns += round(seconds * S)
        self.wall_ns += round(seconds * S) + set_by_s * S
        return self.clock.now_ns()


@pytest.mark.parametrize(
    ("set_by_s", "report"),
    [
        (
            -3600,
            "set back by 3600 s: sample times continue without a step, 3600 s ahead of it, until the site is restarted",
        ),
        (3600, "set forward by 3600 s, or the host was suspended: sample times follow it"),
    ],
)
def test_row_13_a_host_clock_that_is_set_is_reported_once_and_silence_still_counts(set_by_s: int, report: str) -> None:
    host = SetClock()
    host.passes(1.0)
    tray = TrayConfig.model_validate({"name": "bench", "fans": 2, "port": "/dev/ttyTEST"})
    core = SerialCore(tray, AcquisitionConfig(), FakeLink(), host.clock.now_ns(), host.clock)
    core.step(LinkUp())
    feed(core, [sample(0)], t_ns=host.passes(0.01))
    core.tick(host.passes(0.05, set_by_s))
    assert core.problem() == f"the host clock was {report}"
    assert core.counters()["host_clock_steps"] == 1
    (raw,) = feed(core, [sample(1)], t_ns=host.passes(0.01))
    assert raw.host_receive_t_ns[0] > 0
    core.tick(host.passes(1.9))
    assert "nothing received" not in core.problem()
    core.tick(host.passes(0.2))
    assert "nothing received for 2 s" in core.problem(), "a silent line is reported after two seconds, not an hour"
    feed(core, [sample(2)], t_ns=host.passes(60.0))
    core.tick(host.passes(0.05))
    assert core.problem() == ""


def with_columns(number: int, **columns: tuple[float, ...]) -> Sample:
    return replace(sample(number), measured=columns)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_columns_beside_command_and_speed_are_in_the_message_and_the_others_empty(protocol: Protocol) -> None:
    core = make_core(protocol=protocol)
    frame = with_columns(1, supply_voltage_v=(12.0, 11.5), temperature_c=(math.nan, 25.0))
    raw = decode(Raw, encode_message(feed(core, [frame], protocol)[0]))
    assert raw.supply_voltage_v.tolist() == [[12.0, 11.5]]
    assert np.array_equal(raw.temperature_c, [[math.nan, 25.0]], equal_nan=True)
    assert raw.temperature_c.dtype == np.float32
    assert raw.current_a.size == 0
    assert core.notes() == ["the source also measures supply voltage, temperature"]


def test_a_value_that_cannot_be_true_is_unknown_and_counted_and_the_sample_is_kept() -> None:
    core = make_core()
    frame = with_columns(1, supply_voltage_v=(-1.0, 12.0), current_a=(1e9, math.inf), temperature_c=(math.nan, 300.0))
    (raw,) = feed(core, [frame])
    assert np.array_equal(raw.supply_voltage_v, [[math.nan, 12.0]], equal_nan=True)
    assert np.isnan(raw.current_a).all()
    assert np.array_equal(raw.temperature_c, [[math.nan, 300.0]], equal_nan=True)
    assert raw.speed_rad_s.tolist() == [[100.0, 50.0]]
    counts = core.counters()
    assert (counts["absurd_supply_voltage"], counts["absurd_current"]) == (1, 2)
    assert "absurd_temperature" not in counts
    assert core.problem() == ""


def test_a_command_at_a_limit_that_float32_rounds_beyond_it_is_no_absurd_one() -> None:
    assert float(np.float32(0.1)) > 0.1
    for command in (-0.1, 0.3):
        assert len(feed(make_core(command_max=0.3, command_min=-0.1), [sample(0, command=command)])) == 1


@pytest.mark.parametrize(
    ("beyond", "fault", "settings"),
    [
        (
            lambda number, value: sample(number, command=value),
            "absurd_command: command 100 is outside command_min = 0 to command_max = 1",
            "command_min and command_max",
        ),
        (
            lambda number, value: sample(number, speed=value),
            "absurd_speed: speed 100 is beyond speed_max = 40 rpm",
            "speed_max and speed_unit",
        ),
        (
            lambda number, _value: Sample(number, number, (0.5,), (1.0,)),
            "wrong_fan_count: frame of 1 fans, this tray has 2",
            "fans = 2",
        ),
    ],
    ids=["command", "speed", "fans"],
)
def test_a_line_without_a_valid_sample_is_one_problem_that_names_the_setting_whatever_the_values(
    beyond: Callable[[int, float], Sample], fault: str, settings: str
) -> None:
    core, problems = make_core(speed_max=40, speed_unit="rpm"), set[str]()
    for number in range(200):
        feed(core, [beyond(number, 100.0 + number % 50)], t_ns=number * S // 10)
        core.tick(number * S // 10)
        problems.add(core.problem())
    assert problems == {"", f"/dev/ttyTEST: no valid sample ({fault}); check {settings} of the [[tray]]"}


def test_input_of_which_about_a_half_is_faulty_is_one_problem_that_does_not_come_and_go() -> None:
    chance, core, seen = random.Random(3), make_core(), [""]
    for number in range(600):
        good = encode("binary", sample(number))
        core.step(ReceivedBytes(chance.choice((good, good[:9] + b"\0")), S))
        seen.append(core.problem())
    assert [now for before, now in pairwise(seen) if now != before] == seen[-1:]
    assert seen[-1].startswith("/dev/ttyTEST: most input is faulty (")
    assert seen[-1].endswith("check the wiring, and baud = 115200, protocol = 'binary', fans = 2 of the [[tray]]")
    feed(core, map(sample, range(600, 900)))
    assert core.problem() == ""


def test_a_long_piece_is_quoted_in_part_only() -> None:
    core = make_core(protocol="text")
    for piece in (b"\n", b"S 1 2 0.5 " + b"x" * 4900 + b"\n"):
        core.step(ReceivedBytes(piece, 3 * S))
    (note,) = core.notes()
    core.tick(3 * S)
    for text in (note, core.problem()):
        assert "xxx..." in text and len(text) < 250
