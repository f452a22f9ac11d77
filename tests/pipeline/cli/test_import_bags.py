"""`fantwin import` of ROS bags as they are found: what can be read is read, and what cannot be read is named."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zstandard

from tests.support.fantwin_command import error_of, fantwin
from tests.support.written_logs import (
    FLOAT64,
    STAMPED,
    float64,
    stamped,
    write_bag_metadata,
    write_mcap,
    write_rosbag,
)
from tests.support.written_recordings import raw_columns

MESSAGES = 200
START_NS = 1_780_000_000 * 10**9
T_NS = START_NS + 50_000_000 * np.arange(MESSAGES)
DUTY = np.array([0.4, 0.8, 0.6])[np.arange(MESSAGES) // 40 % 3]
RPM = 1000 + 2000 * DUTY + np.arange(MESSAGES) % 3
TOPICS = {
    "/fan/duty": (FLOAT64, [(int(t), float64(u)) for t, u in zip(T_NS, DUTY, strict=True)]),
    "/fan/speed": (FLOAT64, [(int(t), float64(y)) for t, y in zip(T_NS, RPM, strict=True)]),
}
COUNTS = dict.fromkeys(TOPICS, MESSAGES)
OPTIONS = ("--command", "/fan/duty.data", "--speed", "/fan/speed.data:rpm")
ROSBAG = ("--command", "/fans/command.data[*]", "--speed", "/fans/state.velocity[*]:rad/s")
NO_METADATA = "metadata.yaml is missing, as after a recording that was not finished"


def imported(bag: Path, *options: str) -> tuple[int, list[str]]:
    """Samples, and the notes on how the bag was read."""
    found = fantwin("import", bag, *(options or OPTIONS), "-o", bag.parent / "r.mcap", "--force", "--json")
    assert found.exit_code == 0, found.output
    result = json.loads(found.stdout)
    return result["samples"], [note for note in result["notes"] if "without a time of their own" not in note]


def good(folder: Path) -> Path:
    return write_mcap(folder / "bag_0.mcap", TOPICS)


def with_topic(folder: Path, kind: tuple[str, str], data: bytes) -> Path:
    return write_mcap(folder / "bag.mcap", TOPICS | {"/other": (kind, [(START_NS, data)] * 3)})


def a_service(folder: Path) -> Path:
    return with_topic(folder, ("fans/srv/Set_Event", "float64 rpm\n---\nbool ok\n"), float64(1.0))


def a_type_that_does_not_parse(folder: Path) -> Path:
    return with_topic(folder, ("fans/msg/Odd", "float64[ rpm\n"), float64(1.0))


def a_type_with_fields_of_no_type(folder: Path) -> Path:
    return with_topic(folder, ("fans/msg/All", "other_msgs/Fan[] fans\n"), float64(1.0))


def messages_shorter_than_their_type(folder: Path) -> Path:
    return with_topic(folder, FLOAT64, float64(1.0)[:7])


def one_bad_message(folder: Path) -> Path:
    speeds = list(TOPICS["/fan/speed"][1])
    speeds[7] = (speeds[7][0], b"\0\1")
    return write_mcap(folder / "bag.mcap", TOPICS | {"/fan/speed": (FLOAT64, speeds)})


def other_qos(folder: Path) -> Path:
    good(folder)
    write_bag_metadata(folder, ["bag_0.mcap"], COUNTS, qos="- history: 1\\n  depth: 10\\n  reliability: 1")
    return folder


def more_in_metadata(folder: Path) -> Path:
    good(folder)
    write_bag_metadata(folder, ["bag_0.mcap"], COUNTS | {"/fan/speed": 250})
    return folder


def a_part_is_missing(folder: Path) -> Path:
    good(folder)
    write_bag_metadata(folder, ["bag_0.mcap", "bag_1.mcap"], COUNTS)
    return folder


def a_file_that_is_not_listed(folder: Path) -> Path:
    good(folder)
    write_mcap(folder / "bag_9.mcap", TOPICS)
    write_bag_metadata(folder, ["bag_0.mcap"], COUNTS)
    return folder


def broken_metadata(folder: Path) -> Path:
    good(folder)
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: a: [")
    return folder


def no_metadata(folder: Path) -> Path:
    return good(folder).parent


def an_empty_last_part(folder: Path) -> Path:
    good(folder)
    (folder / "bag_1.mcap").write_bytes(b"")
    return folder


def cut(folder: Path) -> Path:
    whole = good(folder)
    path = folder / "cut.mcap"
    path.write_bytes(whole.read_bytes()[: int(0.6 * whole.stat().st_size)])
    return path


def a_damaged_first_chunk(folder: Path) -> Path:
    path = good(folder)
    data = bytearray(path.read_bytes())
    at = data.index(b"\x04\0\0\0zstd") + 60
    data[at : at + 8] = bytes(8)
    path.write_bytes(data)
    return path


def compressed(folder: Path) -> Path:
    whole = good(folder)
    (folder / "bag_0.mcap.zstd").write_bytes(zstandard.compress(whole.read_bytes()))
    whole.unlink()
    return folder


def compressed_messages(folder: Path) -> Path:
    topics = {
        name: (kind, [(t_ns, zstandard.compress(data)) for t_ns, data in messages])
        for name, (kind, messages) in TOPICS.items()
    }
    return write_mcap(folder / "bag.mcap", topics)


@pytest.mark.parametrize(
    ("make", "samples", "notes"),
    [
        (good, 200, []),
        (a_service, 200, ["/other is left out: its type fans/srv/Set_Event is of a service or action"]),
        (
            a_type_that_does_not_parse,
            200,
            ["/other is left out: its type fans/msg/Odd has a definition that cannot be read"],
        ),
        (
            a_type_with_fields_of_no_type,
            200,
            ["/other is left out: the bag does not define its type fans/msg/All, which has fields of 'other_msgs/"],
        ),
        (messages_shorter_than_their_type, 200, ["/other is left out: "]),
        (one_bad_message, 199, ["/fan/speed: 1 of 200 messages cannot be read: "]),
        (other_qos, 200, []),
        (more_in_metadata, 200, ["/fan/speed: 200 of the 250 messages that metadata.yaml counts are in the files"]),
        (a_part_is_missing, 200, ["bag_1.mcap, which metadata.yaml lists, is missing"]),
        (
            a_file_that_is_not_listed,
            200,
            ["bag_9.mcap: left out, as metadata.yaml does not list it; import it by name"],
        ),
        (broken_metadata, 200, ["metadata.yaml cannot be read (mapping values are not allowed here"]),
        (no_metadata, 200, [NO_METADATA]),
        (an_empty_last_part, 200, [NO_METADATA, "left out: "]),
        (
            cut,
            138,
            ["cut.mcap is cut or damaged after 276 messages; if there are more behind, `fantwin info --repair "],
        ),
        (a_damaged_first_chunk, 184, ["bag_0.mcap: damaged chunks, left out: 1"]),
        (compressed, 200, [NO_METADATA]),
        (compressed_messages, 200, []),
    ],
)
def test_what_can_be_read_of_a_bag_is_read_and_the_rest_is_named(
    tmp_path: Path, make: Callable[[Path], Path], samples: int, notes: list[str]
) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    found, said = imported(make(folder))
    assert found == samples
    assert len(said) == len(notes), said
    for note, start in zip(said, notes, strict=True):
        assert note.startswith(start)
        assert "\n" not in note


def test_sqlite_bags_that_were_cut_or_have_a_write_ahead_log(tmp_path: Path) -> None:
    columns = np.column_stack([DUTY, DUTY])
    whole, cut = tmp_path / "bag", tmp_path / "cut.db3"
    write_rosbag(whole, T_NS / 1e9, columns, 3000 * columns, mcap=False)
    data = (whole / "bag.db3").read_bytes()
    cut.write_bytes(data[: int(0.7 * len(data))])
    samples, notes = imported(cut, *ROSBAG)
    assert 100 < samples < MESSAGES
    assert notes[0].startswith("cut.db3 is cut or damaged after ")
    assert notes[0].endswith(f"`sqlite3 {cut} .recover | sqlite3 FIXED.db3` saves them")

    logged = tmp_path / "logged" / "logged_0.db3"
    logged.parent.mkdir()
    with closing(sqlite3.connect(whole / "bag.db3")) as source, closing(sqlite3.connect(logged)) as target:
        target.execute("PRAGMA journal_mode = WAL")
        target.execute("PRAGMA wal_autocheckpoint = 0")
        for name, columns_of in (("topics", "(id, name, type, serialization_format, q, d)"), ("messages", "")):
            target.execute(f"CREATE TABLE {name} {columns_of or '(id, topic_id, timestamp, data)'}")
            rows = source.execute(f"SELECT * FROM {name}").fetchall()
            target.executemany(f"INSERT INTO {name} VALUES ({', '.join('?' * len(rows[0]))})", rows)
        target.commit()
        assert logged.stat().st_size < 20_000 < logged.with_name("logged_0.db3-wal").stat().st_size
        assert imported(logged.parent, *ROSBAG) == (MESSAGES, [NO_METADATA])


@pytest.mark.parametrize(
    ("stamps_ns", "note"),
    [
        (T_NS - 5_000_000, ""),
        (
            np.where(np.arange(MESSAGES) == 9, 0, T_NS),
            "/fan/speed: 1 of 200 messages without a time of their own; that",
        ),
        (
            T_NS - 3 * 10**9 * (np.arange(MESSAGES) > 90),
            "/fan/speed: header.stamp goes back by 2.950 s, as if the clock",
        ),
        (T_NS - START_NS + 10**9, "/fan/speed: header.stamp is of another clock, 1779999999 s from that of the bag"),
    ],
)
def test_stamps_are_the_times_where_all_messages_have_one_of_the_same_clock_that_goes_on(
    tmp_path: Path, stamps_ns: np.ndarray, note: str
) -> None:
    speeds = [(int(t), stamped(int(stamp), y)) for t, stamp, y in zip(T_NS, stamps_ns, RPM, strict=True)]
    bag = write_mcap(tmp_path / "bag.mcap", TOPICS | {"/fan/speed": (STAMPED, speeds)})
    found = fantwin("import", bag, *OPTIONS, "-o", tmp_path / "r.mcap", "--json")
    notes = [each for each in json.loads(found.stdout)["notes"] if not each.startswith("/fan/duty")]
    t_ns, command, _ = raw_columns(tmp_path / "r.mcap")
    if note:
        assert notes[0].startswith(note)
        np.testing.assert_array_equal(t_ns, T_NS)
        np.testing.assert_array_equal(command[:, 0], DUTY)
    else:
        assert notes == []
        np.testing.assert_array_equal(t_ns, stamps_ns[1:])  # no command was known before the first


def test_where_the_clock_of_a_bag_was_set_back_the_longest_part_is_read_and_no_command_holds_beyond(
    tmp_path: Path,
) -> None:
    columns = np.column_stack([DUTY, DUTY])
    write_rosbag(tmp_path / "bag", T_NS / 1e9, columns, 3000 * columns, mcap=False)
    path = tmp_path / "bag" / "bag.db3"
    with closing(sqlite3.connect(path)) as database:  # commands have no stamp; those of the speeds go on
        database.execute("UPDATE messages SET timestamp = timestamp - 20000000000 WHERE id > 240")
        database.commit()
    samples, notes = imported(path, *ROSBAG)
    assert samples == 120
    assert notes[0].startswith("/fans/command.data[0]: time goes back by 19.950 s at row 121, from 2026-05-28 ")
    assert notes[0].endswith(": the longest part is read, 80 rows are left out")


def test_a_bag_of_ros_1_is_read_with_its_types(tmp_path: Path) -> None:
    from rosbags.rosbag1 import Writer  # noqa: PLC0415
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    store, path = get_typestore(Stores.ROS1_NOETIC), tmp_path / "old.bag"
    kind = FLOAT64[0]
    with Writer(path) as writer:
        for topic, values in (("/fan/duty", DUTY), ("/fan/speed", RPM)):
            connection = writer.add_connection(topic, kind, typestore=store)
            for t_ns, value in zip(T_NS, values, strict=True):
                writer.write(connection, int(t_ns), store.serialize_ros1(store.types[kind](data=value), kind))
    assert imported(path) == (MESSAGES, [])
    path.write_bytes(path.read_bytes()[:5000])
    said = error_of("import", path, "--preview")
    assert "no ROS 1 bag that can be read: " in said
    assert said.endswith("`rosbag reindex` mends one that was not finished")


def test_what_is_no_bag_to_import_says_why(tmp_path: Path) -> None:
    two, text, other, recording = (tmp_path / name for name in ("two", "text.mcap", "other.db3", "rec.mcap"))
    two.mkdir()
    write_mcap(two / "a.mcap", TOPICS)
    write_mcap(two / "b.mcap", TOPICS)
    assert error_of("import", two, "--preview").endswith(f"2 bags in it: name one, such as {two / 'a.mcap'}")
    write_mcap(text, {"/t": (("std_msgs/msg/String", "string data\n"), [(1, b"\0\1\0\0\2\0\0\0a\0")])})
    assert error_of("import", text, "--preview").endswith("in this ROS bag: its messages have no numbers")
    write_mcap(text, {"/t": (FLOAT64, [(1, b"{}")])}, encoding="json")
    assert error_of("import", text, "--preview").endswith(
        "/t is left out: its messages are json, not cdr as usual in ROS"
    )
    with closing(sqlite3.connect(other)) as database:
        database.execute("CREATE TABLE fans (rpm)")
    assert error_of("import", other, "--preview").endswith("no ROS bag that can be read: no such table: topics")
    fantwin("import", good(tmp_path), *OPTIONS, "-o", recording)
    said = f"{recording}: is a recording of fantwin already; `fantwin info {recording}` shows it"
    assert error_of("import", recording, "--preview").endswith(said)


def test_info_shows_the_topics_of_a_foreign_bag_and_invents_none(tmp_path: Path) -> None:
    bag = good(tmp_path)
    shown = fantwin("info", bag).stdout
    assert "not a fantwin recording" in shown
    rows = [line.split()[:2] for line in shown.splitlines() if line.startswith("/") and str(bag) not in line]
    assert rows == [["/fan/duty", "200"], ["/fan/speed", "200"]]
