"""The snapshot store: the file is always complete, and an unreadable file is reported in one line."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from pathlib import Path

import pytest

from fantwin.pipeline.runtime.stage import StageError
from fantwin.pipeline.tray_scoring.snapshot_store import AHEAD_NS, RECENT_NS, SnapshotStore
from fantwin.schemas.formats import SNAPSHOT
from fantwin.schemas.messages import ScorerSnapshot


def snapshot(number: int) -> ScorerSnapshot:
    return ScorerSnapshot(t_ns=number, twin_sha256="twin", state_json="{}" * min(number, 1000))


def saved(path: Path) -> int:
    found = SnapshotStore(path).load()
    assert found
    return found.t_ns


def test_the_last_snapshot_is_loaded_again(tmp_path: Path) -> None:
    file = SnapshotStore(tmp_path / "not there yet" / "scorer-tray1.snapshot")
    assert file.load() is None
    for number in (1, 2, 3):
        file.save(snapshot(number))
    assert saved(file.path) == 3
    assert [path.name for path in file.path.parent.iterdir()] == ["scorer-tray1.snapshot"]


def test_a_full_disk_is_reported_until_there_is_room_and_leaves_the_previous_snapshot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = SnapshotStore(tmp_path / "m.snapshot")
    file.save(snapshot(1))

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        file.save(snapshot(2))
    assert file.problem.startswith(
        f"{file.path}: cannot save what was learned of the fans, nor alarms: No space left on device"
    )
    assert saved(file.path) == 1
    file.save(snapshot(3))
    assert (file.problem, saved(file.path)) == ("", 3)


def test_a_file_that_is_no_whole_snapshot_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "m.snapshot"
    SnapshotStore(path).save(snapshot(100))
    for content in (b"\xff\xffgarbage", path.read_bytes()[:-20]):
        path.write_bytes(content)
        with pytest.raises(StageError) as refused:
            SnapshotStore(path).load()
        assert str(refused.value).startswith(f"{path}: not a scorer's snapshot")
        assert "remove it to start without" in str(refused.value) and "\n" not in str(refused.value)
    with pytest.raises(StageError, match="remove it to continue from the one that the recorder keeps, or without"):
        SnapshotStore(path, lambda _is_patient: ((), "")).load()
    with pytest.raises(StageError) as refused:
        SnapshotStore(tmp_path).load()
    assert str(refused.value) == f"{tmp_path}: cannot read the scorer's snapshot: Is a directory"


@pytest.mark.parametrize(
    ("number", "advice"), [(0, "remove it to start without one"), (SNAPSHOT.written + 1, "update fantwin")]
)
def test_a_snapshot_of_an_unknown_format_is_refused_in_one_line(tmp_path: Path, number: int, advice: str) -> None:
    unknown = replace(snapshot(9), format=number)
    store = SnapshotStore(tmp_path / "m.snapshot")
    store.save(unknown)
    with pytest.raises(
        StageError, match=rf"m\.snapshot: a scorer's snapshot .*reads format {SNAPSHOT.written}: {advice}"
    ):
        store.load()
    beside_another = SnapshotStore(tmp_path / "n" / "m.snapshot", lambda _is_patient: ([unknown], ""))
    if number > SNAPSHOT.written:
        with pytest.raises(StageError, match=rf"m: the snapshot that the recorder keeps: .*{advice}"):
            beside_another.load()
    else:
        assert beside_another.load() is None, "nobody can remove it from recordings"
        assert beside_another.note == "what the recorder keeps is of an older version of fantwin, and was left out"


def test_of_a_file_and_what_others_keep_the_newest_counts(tmp_path: Path) -> None:
    store = SnapshotStore(tmp_path / "m.snapshot", lambda _is_patient: ([snapshot(5), snapshot(9)], ""))
    store.save(snapshot(7))
    found = store.load()
    assert found and found.t_ns == 9
    assert store.note == "continued from the snapshot that the recorder keeps; the file here is 0 s older"
    store.save(snapshot(11))
    found = store.load()
    assert found and found.t_ns == 11


def test_a_snapshot_of_a_clock_that_was_ahead_does_not_hide_the_last_one(tmp_path: Path) -> None:
    SnapshotStore(tmp_path / "m.snapshot").save(snapshot(3 * AHEAD_NS))
    store = SnapshotStore(tmp_path / "m.snapshot", lambda _is_patient: ([snapshot(AHEAD_NS)], ""), now_ns=AHEAD_NS)
    found = store.load()
    assert found and found.t_ns == AHEAD_NS
    assert store.note.endswith("; the file here is 2 s newer, because the clock was ahead when it was written")


@pytest.mark.parametrize(("t_ns", "is_patient"), [(None, True), (1, True), (2 * RECENT_NS, False)])
def test_others_are_waited_for_where_there_is_no_recent_file_and_are_asked_once(
    tmp_path: Path, t_ns: int | None, is_patient: bool
) -> None:
    asked: list[bool] = []

    def elsewhere(is_patient: bool) -> tuple[list[ScorerSnapshot], str]:
        asked.append(is_patient)
        return [], "no recorder was there"

    store = SnapshotStore(tmp_path / "m.snapshot", elsewhere, now_ns=2 * RECENT_NS + 1)
    if t_ns is not None:
        store.save(ScorerSnapshot(t_ns=t_ns, twin_sha256="", state_json=""))
    store.load()
    store.load()
    assert asked == [is_patient]
    from_what = "without a snapshot" if t_ns is None else "from the file here"
    assert store.note == f"continued {from_what}: no recorder was there", "nothing is forgotten without a word"
