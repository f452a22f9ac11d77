"""kill -9: the launcher brings a stage back, the others go on, and every sample is recorded or counted as lost."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader

from pipeline.launch.watcher import Watcher
from pipeline.recordings.reading import read_recording
from schemas.topics import tray_key
from tests.support.running_chain import SITE, TRAY, Chain, eventually, fantwin, is_running, published, received, view_of

pytestmark = pytest.mark.slow


@pytest.fixture
def chain(tmp_path: Path, endpoint: str) -> Iterator[Chain]:
    chain = Chain(tmp_path, endpoint)
    try:
        yield chain
    finally:
        chain.close()


def kill(chain: Chain, watcher: Watcher, label: str) -> float:
    """Kill a stage and wait until samples flow through the whole chain again; how long it was away, s."""
    took_s = chain.kill(watcher, label)
    scored = published(view_of(watcher, "scorer"))
    eventually(lambda: published(view_of(watcher, "scorer")) > scored + 50, "scores flow again")
    if label == "recorder":
        eventually(lambda: received(view_of(watcher, "recorder")) > 50, "the new recorder records")
    return took_s


def recorded_sequences(chain: Chain) -> dict[tuple[str, str], set[int]]:
    """(topic, producer) -> sequence numbers in all recordings together."""
    found: dict[tuple[str, str], set[int]] = {}
    for path in chain.recordings():
        for entry in read_recording(path):
            header = entry.message.header
            found.setdefault((entry.topic, header.producer), set()).add(header.sequence)
    return found


def recorded_samples(chain: Chain) -> set[int]:
    """The device's own numbers of the samples in all recordings."""
    entries = (entry for path in chain.recordings() for entry in read_recording(path, topics=["raw"]))
    return {int(number) for entry in entries for number in getattr(entry.message, "device_sequence")}  # noqa: B009


def grid_times(chain: Chain, topic: str) -> set[int]:
    entries = (entry for path in chain.recordings() for entry in read_recording(path, topics=[topic]))
    return {int(t_ns) for entry in entries for t_ns in getattr(entry.message, "t_ns")}  # noqa: B009


def test_every_stage_is_brought_back_the_others_go_on_and_the_account_is_complete(chain):
    chain.start_tray()
    up = chain.start_up()
    with chain.watcher() as watcher:
        eventually(lambda: published(view_of(watcher, "scorer")) > 100, "scores flow")
        kill(chain, watcher, chain.stages[0])
        told = fantwin(*chain.words("status"), "--json")
        (resampler,) = (stage for stage in json.loads(told.stdout)["stages"] if stage["stage"] == "resampler")
        assert told.returncode == 3, "a running site says that it has lost something"
        assert resampler["counters"]["lost_between_sessions"] == resampler["lost"] > 0
        for label in chain.stages[1:]:
            before = chain.process_ids()
            took_s = kill(chain, watcher, label)
            print(f"{label}: back after {took_s:.2f} s")
            after = chain.process_ids()
            assert after[label] != before[label]
            assert is_running(after[label])
            assert {name: after[name] for name in after if name != label} == {
                name: before[name] for name in before if name != label
            }
    assert chain.tray and chain.tray.end() == 0
    sent = chain.tray.output()
    status = up.end()
    account = up.output()

    assert account["restarts"] == dict.fromkeys(chain.stages, 1)
    assert account["killed"] == []
    recorded = recorded_samples(chain)
    lost = sum(account["lost"].values())
    # what nobody took while acquisition was dead has a number of the device too, and counts as lost
    assert sent["samples_unsent"] > 0
    assert len(recorded) + lost >= sent["samples_sent"] + sent["samples_unsent"]
    assert 0 < lost <= sent["samples_unsent"] + 200, "lost is what fell into the pause, not more"
    assert status == 3

    # all that the sessions of each stage sent is in one recording or the other
    for (topic, producer), numbers in recorded_sequences(chain).items():
        assert numbers == set(range(max(numbers) + 1)), f"{topic} of {producer} has holes"
    # and no grid sample was skipped or left without a judgement
    times = sorted(grid_times(chain, "grid"))
    assert times == list(range(times[0], times[-1] + 1, 10_000_000))
    assert grid_times(chain, "prediction") == grid_times(chain, "score") == set(times)

    # and a replay that is given what each session was given decides the same, to the bit
    told = fantwin("replay", "--offline", "--verify", *chain.recordings())
    assert told.returncode == 0, told.stdout + told.stderr


def test_a_killed_recorder_loses_nothing(chain):
    chain.start_tray()
    up = chain.start_up()
    with chain.watcher() as watcher:
        eventually(lambda: received(view_of(watcher, "recorder")) > 300, "the recorder records")
        kill(chain, watcher, "recorder")
    assert chain.tray and chain.tray.end() == 0
    assert up.end() == 0, (up.output()["lost"], up.lines[-3:])
    assert chain.tray.output()["samples_sent"] == len(recorded_samples(chain))
    assert len(chain.recordings()) == 2
    for (topic, producer), numbers in recorded_sequences(chain).items():
        assert numbers == set(range(max(numbers) + 1)), f"{topic} of {producer} has holes"


def test_without_their_launcher_all_stages_end_in_order_and_leave_a_whole_recording(chain):
    chain.start_tray()
    up = chain.start_up()
    with chain.watcher() as watcher:
        eventually(lambda: published(view_of(watcher, "scorer")) > 100, "scores flow")
        children = chain.process_ids()
        up.process.kill()
        eventually(lambda: not any(map(is_running, children.values())), "all stages have ended")
        last = {view.health.stage: view.health.status.name for view in watcher.stages()}
        assert not any(watcher.losses().values())
    assert set(last.values()) == {"STOPPED"}
    assert chain.tray and chain.tray.end() == 0
    (recording,) = chain.recordings()
    assert not list(chain.folder.glob("*.active"))
    with recording.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary and summary.statistics
    topics = {channel.topic: channel.id for channel in summary.channels.values()}
    counts = summary.statistics.channel_message_counts
    grid, prediction, score = (counts[topics[tray_key(SITE, TRAY, name)]] for name in ("grid", "prediction", "score"))
    assert grid == prediction == score > 100, "each stage ended after the one before it"
    assert len(recorded_samples(chain)) == chain.tray.output()["samples_sent"]
