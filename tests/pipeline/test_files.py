"""A file that is replaced is whole: that of before, or the new one."""

from __future__ import annotations

import errno
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fantwin.pipeline.files import PRIVATE, is_read_by_others, replace_file


def mode_of(path: Path) -> int:
    return path.stat().st_mode & 0o777


@pytest.mark.parametrize("failing", ["write", "fsync", "replace"])
def test_what_cannot_be_written_leaves_the_file_of_before_and_nothing_else(failing, tmp_path, monkeypatch):
    path = tmp_path / "kept"
    replace_file(path, b"before")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if failing == "write":
        monkeypatch.setattr("fantwin.pipeline.files.os.fdopen", full)
    elif failing == "fsync":
        monkeypatch.setattr("fantwin.pipeline.files.os.fsync", full)
    else:
        monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        replace_file(path, b"after")
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_keeps_who_may_read_it_unless_told_and_a_private_one_never_had_others(tmp_path, monkeypatch):
    path = tmp_path / "new" / "folder" / "kept"
    replace_file(path, b"1")
    path.chmod(0o640)
    replace_file(path, b"2")
    assert (path.read_bytes(), mode_of(path)) == (b"2", 0o640)
    seen: list[int] = []
    monkeypatch.setattr("fantwin.pipeline.files.os.fsync", lambda file: seen.append(os.fstat(file).st_mode & 0o777))
    replace_file(path, b"3", PRIVATE)
    assert (path.read_bytes(), mode_of(path), seen[0]) == (b"3", PRIVATE, PRIVATE)


@pytest.mark.parametrize(
    ("mode", "owner", "is_read"),
    [(0o600, 1000, False), (0o640, 1000, True), (0o604, 1000, True), (0o440, 0, False), (0o444, 0, True)],
)
def test_a_secret_of_root_may_be_read_by_its_group_as_service_managers_and_clusters_hand_it_over(
    monkeypatch, mode, owner, is_read
):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert is_read_by_others(os.stat_result((mode, 0, 0, 1, owner, 1000, 0, 0, 0, 0))) == is_read


def test_writers_of_one_file_do_not_disturb_one_another(tmp_path):
    path, wholes = tmp_path / "kept", [bytes([number]) * 10_000 for number in range(4)]
    with ThreadPoolExecutor(len(wholes)) as pool:
        written = [pool.submit(lambda whole=whole: [replace_file(path, whole) for _ in range(50)]) for whole in wholes]
        while not all(each.done() for each in written):
            assert not path.exists() or path.read_bytes() in wholes
    assert all(each.exception() is None for each in written) and list(tmp_path.iterdir()) == [path]
