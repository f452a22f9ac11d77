"""pipeline.memory_file: what is kept is whole whatever happens, and what cannot be read is told in one line."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from pipeline.memory_file import MemoryFile
from pipeline.stage import StageError
from schemas.messages import Memory


def memory(number: int) -> Memory:
    return Memory(t_ns=number, twin_sha256="twin", state_json="{}" * number)


def kept(path: Path) -> int:
    found = MemoryFile(path).load()
    assert found
    return found.t_ns


def test_what_was_kept_last_is_found_again(tmp_path: Path) -> None:
    file = MemoryFile(tmp_path / "not there yet" / "scorer-tray1.memory")
    assert file.load() is None
    for number in (1, 2, 3):
        file.keep(memory(number))
    assert kept(file.path) == 3
    assert [path.name for path in file.path.parent.iterdir()] == ["scorer-tray1.memory"]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_kill_at_any_step_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    file = MemoryFile(tmp_path / "m.memory")
    file.keep(memory(1))

    def killed(*_: object) -> None:
        raise SystemExit

    with monkeypatch.context() as patch:
        if step == "fsync":
            patch.setattr(os, "fsync", killed)
        else:
            patch.setattr(Path, "replace", killed)
        with pytest.raises(SystemExit):
            file.keep(memory(2))
    assert kept(file.path) == 1
    file.keep(memory(3))
    assert kept(file.path) == 3


def test_a_full_disk_is_told_until_there_is_room_and_leaves_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = MemoryFile(tmp_path / "m.memory")
    file.keep(memory(1))

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        file.keep(memory(2))
    assert file.problem.startswith(f"{file.path}: cannot keep baselines and alarms: No space left on device")
    assert kept(file.path) == 1
    file.keep(memory(3))
    assert (file.problem, kept(file.path)) == ("", 3)


def test_two_trays_keep_theirs_apart(tmp_path: Path) -> None:
    for name, number in (("scorer-a.1.memory", 1), ("scorer-a.2.memory", 2)):
        MemoryFile(tmp_path / name).keep(memory(number))
    assert (kept(tmp_path / "scorer-a.1.memory"), kept(tmp_path / "scorer-a.2.memory")) == (1, 2)


def test_what_is_no_memory_is_told_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "m.memory"
    path.write_bytes(b"\xff\xffgarbage")
    with pytest.raises(StageError) as refused:
        MemoryFile(path).load()
    assert str(refused.value).startswith(f"{path}: not what a scorer kept")
    assert "remove it to begin anew" in str(refused.value) and "\n" not in str(refused.value)


def test_a_half_of_one_is_told(tmp_path: Path) -> None:
    path = tmp_path / "m.memory"
    MemoryFile(path).keep(memory(100))
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(StageError, match="remove it to begin anew"):
        MemoryFile(path).load()


def test_what_cannot_be_read_is_told_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(StageError) as refused:
        MemoryFile(tmp_path).load()
    assert str(refused.value) == f"{tmp_path}: cannot read what the scorer knew: Is a directory"
