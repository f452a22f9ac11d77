"""pipeline.runtime.snapshot_store: what is kept is whole whatever happens, and what cannot be read is told in one
line."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from pipeline.runtime.snapshot_store import SnapshotStore
from pipeline.runtime.stage import StageError
from schemas.messages import ScorerSnapshot


def snapshot(number: int) -> ScorerSnapshot:
    return ScorerSnapshot(t_ns=number, twin_sha256="twin", state_json="{}" * number)


def kept(path: Path) -> int:
    found = SnapshotStore(path).load()
    assert found
    return found.t_ns


def test_what_was_kept_last_is_found_again(tmp_path: Path) -> None:
    file = SnapshotStore(tmp_path / "not there yet" / "scorer-tray1.snapshot")
    assert file.load() is None
    for number in (1, 2, 3):
        file.keep(snapshot(number))
    assert kept(file.path) == 3
    assert [path.name for path in file.path.parent.iterdir()] == ["scorer-tray1.snapshot"]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_kill_at_any_step_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    file = SnapshotStore(tmp_path / "m.snapshot")
    file.keep(snapshot(1))

    def killed(*_: object) -> None:
        raise SystemExit

    with monkeypatch.context() as patch:
        if step == "fsync":
            patch.setattr(os, "fsync", killed)
        else:
            patch.setattr(Path, "replace", killed)
        with pytest.raises(SystemExit):
            file.keep(snapshot(2))
    assert kept(file.path) == 1
    file.keep(snapshot(3))
    assert kept(file.path) == 3


def test_a_full_disk_is_told_until_there_is_room_and_leaves_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = SnapshotStore(tmp_path / "m.snapshot")
    file.keep(snapshot(1))

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        file.keep(snapshot(2))
    assert file.problem.startswith(f"{file.path}: cannot keep baselines and alarms: No space left on device")
    assert kept(file.path) == 1
    file.keep(snapshot(3))
    assert (file.problem, kept(file.path)) == ("", 3)


def test_two_trays_keep_theirs_apart(tmp_path: Path) -> None:
    for name, number in (("scorer-a.1.snapshot", 1), ("scorer-a.2.snapshot", 2)):
        SnapshotStore(tmp_path / name).keep(snapshot(number))
    assert (kept(tmp_path / "scorer-a.1.snapshot"), kept(tmp_path / "scorer-a.2.snapshot")) == (1, 2)


def test_what_is_no_memory_is_told_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "m.snapshot"
    path.write_bytes(b"\xff\xffgarbage")
    with pytest.raises(StageError) as refused:
        SnapshotStore(path).load()
    assert str(refused.value).startswith(f"{path}: not what a scorer kept")
    assert "remove it to begin anew" in str(refused.value) and "\n" not in str(refused.value)


def test_a_half_of_one_is_told(tmp_path: Path) -> None:
    path = tmp_path / "m.snapshot"
    SnapshotStore(path).keep(snapshot(100))
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(StageError, match="remove it to begin anew"):
        SnapshotStore(path).load()


def test_what_cannot_be_read_is_told_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(StageError) as refused:
        SnapshotStore(tmp_path).load()
    assert str(refused.value) == f"{tmp_path}: cannot read what the scorer knew: Is a directory"
