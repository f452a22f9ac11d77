"""What stages have refused: messages of others, and input of devices."""

from __future__ import annotations

import pytest

from fantwin.pipeline.site.loss_accounting import refused, refused_lines, unusable_lines
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import Counter, Health
from fantwin.schemas.wire import DEVICE_COUNTERS, FaultKind
from tests.support import made_messages

LAUNCHED = {("acquisition/bench", 7)}


def health(name: str = "acquisition/bench", process_id: int = 7, /, **counters: int) -> Health:
    stage, instance = name.split("/")
    counts = tuple(Counter(name=name, value=value) for name, value in counters.items())
    status = StageStatus.STOPPED
    return made_messages.health(stage, instance, status=status, process_id=process_id, counters=counts)


def test_row_10_what_sessions_have_refused_is_added_up():
    sessions = [health("recorder/all", refused_forged=5, refused_clocks=0)] * 2
    assert refused([*sessions, health(samples=3)]) == {"recorder": {"refused_forged": 10}}
    assert refused_lines(refused(sessions)) == ["recorder: refused: 10 messages in the name of another session"]


def test_noise_on_a_line_is_listed_with_its_kinds():
    found = refused([health(samples=9, garbage=3, truncated=1, resync=1, refused_input=4)])
    assert found == {"acquisition/bench": {"garbage": 3, "truncated": 1, "refused_input": 4}}
    words = "4 pieces of input that are no usable sample (garbage 3, truncated 1)"
    assert refused_lines(found) == [f"acquisition/bench: refused: {words}"]


def test_what_a_device_counts_itself_has_a_line_of_its_own():
    counts = {"device_frames": 7, "device_glitches": 900, "device_bad_crc": 3, "device_lost_edges": 1}
    found = refused([health(samples=9, **counts), health(device_bad_crc=1, device_overruns=0)])
    assert found == {"acquisition/bench": {"device_bad_crc": 4, "device_lost_edges": 1}}
    words = "4 frames with a wrong checksum, 1 tacho edge that came too fast"
    assert refused_lines(found) == [f"acquisition/bench: counted by the device itself: {words}"]
    assert unusable_lines([health(device_bad_crc=4)], LAUNCHED) == []


def test_a_device_of_which_all_was_refused_is_named_with_the_count_and_the_setting():
    sessions = [health(absurd_command=400, garbage=2, refused_input=402), health(absurd_command=10, refused_input=10)]
    assert unusable_lines(sessions, LAUNCHED) == [
        "acquisition/bench: no sample could be used, 412 were refused (absurd_command 410, garbage 2): "
        "check command_min and command_max of the [[tray]]"
    ]
    assert unusable_lines([health("acquisition/bench", 8, garbage=30, refused_input=30)], LAUNCHED) == [], "of others"
    (line,) = unusable_lines([health(samples=50, absurd_samples=50, absurd_speed=200)], LAUNCHED)
    assert line.endswith("50 were refused (absurd_samples 50): check speed_max and speed_unit of the [[tray]]")


def test_all_that_a_device_counts_and_every_fault_of_its_line_has_its_words():
    counters = {f"device_{name}": 2 for name in DEVICE_COUNTERS}
    assert set(refused([health(**counters)])["acquisition/bench"]) == set(counters) - {
        "device_frames",
        "device_glitches",
    }
    for kind in set(FaultKind) - {FaultKind.RESYNC, FaultKind.UNKNOWN_TYPE}:  # these are harmless
        (line,) = unusable_lines([health(refused_input=1, **{kind.value: 1})], LAUNCHED)
        assert "source of the [[tray]]" not in line, kind


@pytest.mark.parametrize(
    "counters",
    [
        {"samples": 1, "garbage": 30, "refused_input": 30},
        {"samples": 51, "absurd_samples": 50},
        {"resync": 1},
        {"line_up": 1},
        {},
    ],
)
def test_some_noise_and_a_device_that_sends_nothing_are_not_named(counters: dict[str, int]):
    assert unusable_lines([health(**counters)], LAUNCHED) == []
