"""The output of `fantwin up`: a reader that goes away, a full disk and repetitions do no harm."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from fantwin.pipeline.launch import site_report
from fantwin.pipeline.launch.site_report import FOLD_S, QUEUE_SIZE, EventLog, RepeatedLines
from tests.support.running_chain import DEADLINE_S, eventually


@pytest.fixture(autouse=True)
def whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """`close` writes all."""
    monkeypatch.setattr(site_report, "_CLOSE_LIMIT_S", DEADLINE_S)


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    """The reading and the writing end of a pipe."""
    ends = os.pipe()
    yield ends
    for end in ends:
        with suppress(OSError):
            os.close(end)


def without_times(text: str) -> str:
    """The lines, each of which begins with its time of day."""
    return re.sub(r"^\d\d:\d\d:\d\d  ", "", text, flags=re.MULTILINE)


def test_lines_arrive_in_order_with_their_time_of_day_and_repetitions_at_the_end(pipe):
    log = EventLog(pipe[1])
    for line in ("a", "b", "a", "a", "c"):
        log.say(line)
    log.close()
    written = os.read(pipe[0], 1000).decode()
    assert without_times(written) == "a\nb\nc\na ... repeated 2 times\n"
    assert len(written) == len(without_times(written)) + 4 * len("12:00:00  ")


def test_control_characters_of_a_stage_or_an_alarm_do_not_reach_the_terminal(pipe):
    log = EventLog(pipe[1])
    log.say("ALARM  tray1  fan 2: \x1b[2J\x1b]0;owned\x07slow\x9b31m\r\nok \u202e°")
    log.close()
    assert without_times(os.read(pipe[0], 1000).decode()) == "ALARM  tray1  fan 2:  [2J ]0;owned slow 31m  ok  °\n"


def test_row_08_a_reader_that_has_gone_ends_nothing(pipe):
    os.close(pipe[0])
    log = EventLog(pipe[1])
    for number in range(5):
        log.say(f"line {number}")
    log.close()
    assert not log._thread.is_alive()


def test_row_08_a_reader_that_does_not_read_delays_nothing_and_learns_how_many_lines_are_missing(pipe):
    os.set_blocking(pipe[0], False)
    log = EventLog(pipe[1])
    long = "x" * 200
    for number in range(3 * QUEUE_SIZE):
        log.say(f"{number} {long}")
    read = b""

    def is_empty() -> bool:
        nonlocal read
        try:
            read += os.read(pipe[0], 1 << 20)
        except BlockingIOError:
            return log._queue.empty()
        return False

    eventually(is_empty, "all is read")
    log.say("the end")
    log.close()
    read += os.read(pipe[0], 1 << 20)
    lines = read.decode().splitlines()
    missing = sum(int(line.split()[0].strip("(")) for line in lines if "lines could not be written" in line)
    written = sum(line.endswith(long) for line in lines)
    assert without_times(lines[-1]) == "the end"
    assert missing > 0
    assert missing + written == 3 * QUEUE_SIZE


def test_row_08_a_full_disk_under_the_log_ends_nothing(small_disk: Path, monkeypatch: pytest.MonkeyPatch):
    path = small_disk / "up.log"
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    log = EventLog(descriptor)
    log.say("before")
    eventually(lambda: without_times(path.read_text()) == "before\n", "the first line is written")
    ballast = small_disk / "ballast"
    with pytest.raises(OSError, match="No space left"):
        ballast.write_bytes(bytes(64_000_000))
    tried: list[str] = []
    write = log._write
    monkeypatch.setattr(log, "_write", lambda line: (write(line), tried.append(line)))
    for number in range(100):
        log.say(f"{number} {'x' * 200}")
    eventually(lambda: len(tried) == 100, "all lines were tried")
    ballast.unlink()
    log.say("after")
    log.close()
    os.close(descriptor)
    assert "lines could not be written)\nafter\n" in without_times(path.read_text())


def test_a_line_that_comes_every_second_is_written_less_and_less_often():
    lines, written = RepeatedLines(), {}
    for second in range(100):
        written[second] = [*lines.due(second), *lines.add("the disk is full", second)]
    assert {second: found for second, found in written.items() if found} == {
        0: ["the disk is full"],
        FOLD_S: ["the disk is full ... repeated 9 times"],
        3 * FOLD_S: ["the disk is full ... repeated 20 times"],
        7 * FOLD_S: ["the disk is full ... repeated 40 times"],
    }
    lines = RepeatedLines()
    assert (lines.add("a", 0), lines.due(FOLD_S), lines.add("a", FOLD_S)) == (["a"], [], ["a"]), "later it is again"
