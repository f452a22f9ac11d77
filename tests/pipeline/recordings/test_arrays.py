"""Recordings as arrays: every row of a topic once, as it was sent, in blocks that do not grow with the file."""

import tracemalloc
from collections.abc import Iterable

import numpy as np
import pytest

from fantwin.pipeline.recordings import read_arrays
from fantwin.pipeline.recordings.arrays import Arrays, Block, block_columns
from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.schemas.enums import InvalidReason, Statistic
from fantwin.schemas.health import Counter
from fantwin.schemas.messages import Array
from tests.support.made_messages import health
from tests.support.score_data import made_up_tray
from tests.support.small_recordings import raw, write


def together(blocks: Iterable[Block], name: str) -> Array:
    return np.concatenate([block[name] for block in blocks])


def times(arrays: Arrays) -> list[int]:
    return together(arrays, "host_receive_t_ns").tolist()


def test_the_columns_are_those_of_the_messages(tmp_path):
    scores, _ = made_up_tray(seconds=2, gap_s=(1.0, 1.5))
    (block,) = read_arrays(write(tmp_path / "r.mcap", scores), "score")
    assert (block.site, block.tray, block.topic, block.fans, len(block)) == ("plant", "tray1", "score", 3, 200)
    assert list(block.columns) == list(block_columns(type(scores[0])))
    assert next(iter(block.columns)) == "t_ns"
    for name, column in block_columns(type(scores[0])).items():
        if not column.once:
            np.testing.assert_array_equal(block[name], np.concatenate([getattr(s, name) for s in scores]), name)
            assert block[name].dtype == column.dtype
    assert block["measured_speed_rad_s"].shape == (200, 3)
    assert set(block["period_ns"]) == {scores[0].period_ns}
    assert set(block["producer"]) == {"test"}
    assert block["invalid_reason"][120, 1] == InvalidReason.GAP
    assert block.names("invalid_reason")[120].tolist() == ["NONE", "GAP", "NONE"]
    assert set(block.names("statistic").ravel()) <= {statistic.name for statistic in Statistic}
    with pytest.raises(ValueError, match=r"score\.command is not an enum"):
        block.names("command")
    assert np.isnan(block["measured_speed_rad_s"][120, 1])


@pytest.mark.parametrize(("rows", "lengths"), [(20, [20, 20, 20, 10]), (25, [30, 30, 10])])
def test_blocks_have_the_rows_asked_for_or_a_little_more(tmp_path, rows, lengths):
    path = write(tmp_path / "r.mcap", (raw(n) for n in range(7)))
    blocks = list(read_arrays(path, "raw", rows=rows))
    assert [len(block) for block in blocks] == lengths
    assert together(blocks, "host_receive_t_ns").tolist() == list(range(70))
    np.testing.assert_array_equal(
        together(blocks, "speed_rad_s"), np.concatenate([raw(n).speed_rad_s for n in range(7)])
    )


def test_each_tray_has_its_own_blocks_and_one_can_be_chosen(tmp_path):
    both = [raw(n, tray=tray, fans=fans) for n in range(5) for tray, fans in (("left", 2), ("right", 3))]
    path = write(tmp_path / "r.mcap", both)
    blocks = list(read_arrays(path, "raw", rows=20))
    assert [(block.tray, block.fans, len(block)) for block in blocks] == [
        ("left", 2, 20),
        ("right", 3, 20),
        ("left", 2, 20),
        ("right", 3, 20),
        ("left", 2, 10),
        ("right", 3, 10),
    ]
    (right,) = read_arrays(path, "raw", tray="right")
    np.testing.assert_array_equal(right["command"], np.concatenate([raw(n, fans=3).command for n in range(5)]))
    assert list(read_arrays(path, "raw", tray="nobody")) == []


def test_a_block_ends_where_the_form_of_the_messages_changes(tmp_path):
    messages = [raw(0), raw(1, clock=False), raw(2, clock=False), raw(3, clock=False, fans=4)]
    blocks = list(read_arrays(write(tmp_path / "r.mcap", messages), "raw"))
    assert [(len(b), b.fans, len(b["device_clock_us"])) for b in blocks] == [(10, 2, 10), (20, 2, 0), (10, 4, 0)]


def test_health_belongs_to_no_tray_and_keeps_its_order(tmp_path):
    healths = [
        health(stage, sequence=number, t_ns=number, counters=(Counter(name="lost_frames", value=3),))
        for number in range(2)
        for stage in ("scorer", "resampler")
    ]
    (block,) = read_arrays(write(tmp_path / "r.mcap", healths), "health", tray="tray1")
    assert (block.tray, block["stage"].tolist()) == ("", ["scorer", "resampler"] * 2)
    assert "counters" not in block.columns


def test_parts_in_any_order_are_one_recording_each_time_it_is_read_and_duplicates_count_once(tmp_path):
    first = write(tmp_path / "z.mcap", (raw(n) for n in range(6)))
    second = write(tmp_path / "a.mcap", (raw(n) for n in range(4, 9)), start=100)
    third = write(tmp_path / "b.mcap", (raw(n, producer="b") for n in range(9, 11)), start=200)
    arrays = read_arrays([third, second, first], "raw")
    assert times(arrays) == times(arrays) == list(range(110))
    assert arrays.duplicated == 2
    assert times(read_arrays([first, first], "raw")) == list(range(60))
    same_numbers = [raw(0, producer="a"), raw(0, producer="b"), raw(0, tray="other")]
    arrays = read_arrays(write(tmp_path / "r.mcap", same_numbers), "raw")
    assert (sum(len(block) for block in arrays), arrays.duplicated) == (30, 0), "numbers are of a producer and a key"


def test_an_imported_recording_is_not_a_part_of_another(tmp_path):
    made = [write(tmp_path / f"{n}.mcap", [raw(0)], {"source": "table.csv"}) for n in (1, 2)]
    with pytest.raises(RecordingError, match=r"1\.mcap: made by .* so it is not a part"):
        read_arrays(made, "raw")
    assert times(read_arrays(made[0], "raw")) == list(range(10))


def test_memory_does_not_grow_with_the_file(tmp_path):
    def peak(messages: int) -> int:
        """Peak memory in bytes while all blocks of a recording are read, one at a time."""
        path = write(tmp_path / "r.mcap", (raw(n, samples=100, fans=16) for n in range(messages)))
        tracemalloc.start()
        rows = sum(len(block) for block in read_arrays(path, "raw", rows=500))
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert rows == 100 * messages
        return most

    peak(5)  # what is imported and cached on first use
    assert peak(90) < 1.5 * peak(15)


def test_unknown_topics_and_unreadable_files_are_a_one_line_error(tmp_path):
    path = write(tmp_path / "r.mcap", [raw(0)])
    with pytest.raises(RecordingError, match=r"no topic is called 'scor'; known: raw, grid, prediction, score"):
        read_arrays(path, "scor")
    with pytest.raises(RecordingError, match=r"none\.mcap: cannot read the recording: No such file"):
        read_arrays(tmp_path / "none.mcap", "raw")
    with pytest.raises(RecordingError, match=r"none\.mcap: cannot read the recording: No such file"):
        read_arrays([path, tmp_path / "none.mcap"], "raw")
