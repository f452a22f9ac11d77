"""A file that is replaced is whole: that of before, or the new one."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from fantwin.pipeline.files import PRIVATE, replace_file


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
    assert mode_of(path) & 0o044, "a new one is public"
    path.chmod(0o640)
    replace_file(path, b"2")
    assert (path.read_bytes(), mode_of(path)) == (b"2", 0o640)
    left_by_a_crash = path.with_name(f".{path.name}.new")
    left_by_a_crash.write_bytes(b"a part of it, and longer than what follows")
    seen: list[int] = []
    monkeypatch.setattr("fantwin.pipeline.files.os.fsync", lambda file: seen.append(os.fstat(file).st_mode & 0o777))
    replace_file(path, b"3", PRIVATE)
    assert (path.read_bytes(), mode_of(path), seen[0]) == (b"3", PRIVATE, PRIVATE)
