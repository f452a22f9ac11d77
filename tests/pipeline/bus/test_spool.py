"""The spool: what memory no longer keeps is on disk, within its limits; a bad disk costs a line and nothing else."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable
from pathlib import Path
from queue import SimpleQueue

import pytest

from fantwin.pipeline.bus import publisher as publisher_module
from fantwin.pipeline.bus import spool as spool_module
from fantwin.pipeline.bus.recovery import Answer
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.bus.spool import Spool, SpooledStream
from fantwin.pipeline.config.models import BusConfig
from fantwin.schemas.topics import BY_NAME, tray_key
from tests.support.running_chain import eventually
from tests.support.small_disk import SIZE_BYTES

LARGE = 100 << 20


class Time:
    """Monotonic time that the test sets."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


def payload(number: int) -> bytes:
    return number.to_bytes(4, "big") * 25


def numbers(found: Iterable[bytes]) -> list[int]:
    return [int.from_bytes(each[:4], "big") for each in found]


def fill(stream: SpooledStream, first: int, end: int) -> None:
    for number in range(first, end):
        stream.add(number, payload(number))


def test_any_range_is_read_again_while_more_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(spool_module, "FILE_BYTES", 1000)
    spool = Spool(tmp_path / "s", LARGE, 900.0)
    one, other = spool.stream(), spool.stream()
    for first in range(0, 100, 5):
        fill(one, first, first + 5)
        fill(other, 1000 + first, 1005 + first)
        assert numbers(one.read(max(0, first - 30), first + 5)) == [*range(max(0, first - 30), first + 5)]
    assert numbers(one.read(17, 63)) == [*range(17, 63)]
    assert numbers(other.read(0, 1003)) == [1000, 1001, 1002]
    assert len(list((tmp_path / "s").iterdir())) > 10
    assert spool.problem() == ""


def test_the_oldest_files_of_all_publishers_are_removed_beyond_the_size(tmp_path, monkeypatch):
    monkeypatch.setattr(spool_module, "FILE_BYTES", 500)
    spool = Spool(tmp_path, 5000, 900.0)
    one, other = spool.stream(), spool.stream()
    for number in range(100):
        one.add(number, payload(number))
        other.add(number, payload(number))
        assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 5000 + 500
    kept = numbers(one.read(0, 100))
    assert 15 < len(kept) < 25
    assert kept == [*range(100 - len(kept), 100)]
    assert spool.problem() == ""


def test_a_file_that_is_removed_while_its_publisher_still_writes_to_it_counts_no_longer(tmp_path):
    now = Time()
    spool = Spool(tmp_path, LARGE, 160.0, now)
    rare, frequent = spool.stream(), spool.stream()
    rare.add(0, payload(0))
    now.now_s += 170.0
    fill(frequent, 0, 5)
    assert numbers(rare.read(0, 9)) == [], "too old"
    rare.add(1, payload(1))
    assert numbers(rare.read(0, 9)) == [1]


def test_the_size_of_a_file_that_was_removed_while_it_was_written_is_not_kept(tmp_path):
    now = Time()
    spool = Spool(tmp_path, 10_000_000, 160.0, now)
    begun = spool.begin(0)
    assert begun
    file, opened = begun
    spool.grow(file, 0, 5_000_000)
    now.now_s += 170.0
    spool.stream().add(0, payload(0))
    assert not spool.is_kept(file)
    assert not spool.grow(file, 1, 5_000_000), "the message is gone with its file"
    opened.close()
    assert spool.note() == "0 MB of messages are kept on disk"


def test_what_is_too_old_is_removed(tmp_path):
    now = Time()
    spool = Spool(tmp_path, LARGE, 160.0, now)
    stream = spool.stream()
    for number in range(300):
        now.now_s += 1.0
        stream.add(number, payload(number))
    kept = numbers(stream.read(0, 300))
    assert kept[-1] == 299
    assert 160 <= len(kept) <= 175


def test_what_an_earlier_process_left_is_removed_and_said_and_nothing_stays_at_the_end(tmp_path):
    folder = tmp_path / "spool" / "acquisition-tray1"
    killed = Spool(folder, LARGE, 900.0)
    fill(killed.stream(), 0, 10)
    spool = Spool(folder, LARGE, 900.0)
    assert list(tmp_path.rglob("*.spool")) == []
    assert spool.note() == "1 files of messages that an earlier process had kept were removed"
    fill(spool.stream(), 0, 10)
    spool.close()
    assert not folder.parent.exists()


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[: len(content) // 2],
        lambda content: content[:200] + b"\xff" + content[201:],
        lambda content: b"\xff" * len(content),
        lambda _content: None,
    ],
    ids=["cut", "one byte", "all bytes", "gone"],
)
def test_a_damaged_file_costs_its_own_messages_and_one_line(
    tmp_path, monkeypatch, damage: Callable[[bytes], bytes | None]
):
    monkeypatch.setattr(spool_module, "FILE_BYTES", 1000)
    now = Time()
    spool = Spool(tmp_path, LARGE, 900.0, now)
    stream = spool.stream()
    fill(stream, 0, 40)
    path = tmp_path / "2.spool"
    left = damage(path.read_bytes())
    path.unlink()
    if left is not None:
        path.write_bytes(left)
    found = numbers(stream.read(0, 40))
    assert found == sorted(set(found))
    assert set(range(40)) - set(found) <= set(range(9, 18))
    assert len(found) < 40
    assert spool.problem() == f"messages that were kept on disk cannot be read again ({path}): check the disk"
    now.now_s += spool_module.DAMAGE_SHOWN_S
    assert spool.problem() == ""


def test_a_full_disk_costs_one_line_and_what_does_not_fit_until_there_is_room(small_disk):
    now = Time()
    spool = Spool(small_disk / "s", LARGE, 900.0, now)
    stream = spool.stream()
    hog = small_disk / "hog"
    fill(stream, 0, 10)
    with hog.open("wb", buffering=0) as file, pytest.raises(OSError, match="No space"):
        for _ in range(SIZE_BYTES // 4096 + 1):
            file.write(bytes(4096))
    fill(stream, 10, 100)
    assert spool.problem().startswith(
        f"messages cannot be kept on disk in {small_disk / 's'} (No space left on device)"
    )
    hog.unlink()
    fill(stream, 100, 110)
    now.now_s += spool_module.WRITTEN_AGAIN_S
    fill(stream, 110, 120)
    assert spool.problem() == ""
    found = numbers(stream.read(0, 200))
    assert found == sorted(set(found))
    assert {*range(10), *range(110, 120)} <= set(found)
    assert not {*range(60, 110)} & set(found)


def test_an_error_of_the_disk_never_reaches_the_publisher(tmp_path, monkeypatch):
    spool = Spool(tmp_path / "s", LARGE, 900.0)
    (tmp_path / "s").write_text("no folder")
    stream = spool.stream()
    fill(stream, 0, 10)
    assert numbers(stream.read(0, 10)) == []
    assert spool.problem().startswith(f"messages cannot be kept on disk in {tmp_path / 's'} (File exists)")

    def refuse(*_arguments: object, **_named: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(Path, "mkdir", refuse)
    spool = Spool(tmp_path / "t", LARGE, 900.0)
    fill(spool.stream(), 0, 10)
    assert "Input/output error" in spool.problem()


def test_row_16_a_consumer_gets_from_disk_what_memory_no_longer_keeps_in_several_answers(
    tmp_path, endpoint, monkeypatch
):
    monkeypatch.setattr(publisher_module, "KEPT_BYTES", 1000)
    monkeypatch.setattr(publisher_module, "MOST_RECOVERED_MESSAGES", 60)
    key, answers = tray_key("s", "a", "raw"), SimpleQueue[Answer]()
    config = BusConfig(endpoint=endpoint)
    with Bus(config) as bus, Bus(config) as asker:
        bus.spool = Spool(tmp_path / "s", LARGE, 900.0)
        publisher = bus.publisher(key, BY_NAME["raw"], "", "p")
        for number in range(100):
            publisher.put(payload(number))
        assert len(publisher._kept) == 10
        eventually(lambda: asker.recover(key, "p"), "they have met")
        found: list[int] = []
        published = None
        while published is None:
            asker.request_missed(key, "p", len(found), 99, 20.0, answers.put)
            answer = answers.get(timeout=20)
            published = answer.published
            assert 0 < len(answer.messages) <= 60
            found += numbers(each for _, each in answer.messages)
    assert found == [*range(100)]
    assert published == 100
    assert not (tmp_path / "s").exists(), "nothing stays once the producer has left"
