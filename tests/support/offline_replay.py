"""Offline replays of recordings that a test makes or changes."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.replay.offline.comparison import Comparison
from fantwin.pipeline.replay.offline.replay_input import open_replay_input
from fantwin.pipeline.replay.offline.rescoring import RescoredTray, rescore
from fantwin.pipeline.replay.offline.verify import TrayVerifier
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Score
from tests.support.killed_site import Site


def verified(*paths: Path) -> RescoredTray:
    with open_replay_input(paths, None, (), None) as replay_input:
        (tray,) = rescore(replay_input, None, verify=True)
    assert tray.comparison
    return tray


def made_equal(tray: RescoredTray, share: float = 0.0) -> int:
    """How many samples were equal; none may differ. share: of the tolerance that numbers may use: none of it where the
    recording was made on this machine."""
    found = tray.comparison
    assert found and found.is_equal and found.largest.share <= share, found
    return found.counts["samples_equal"]


def verified_in_part(*paths: Path) -> Comparison:
    """The comparison of a recording that lacks something: what can be compared is equal."""
    found = verified(*paths).comparison
    assert found and found.is_equal and found.counts["samples_equal"] and found.counts["samples_not_comparable"], found
    return found


def recorded(path: Path, topic: str) -> list[Any]:
    return [entry.message for entry in read_recording(path, (topic,))]


def changed(path: Path, out: Path, change) -> Path:
    """A copy whose messages have gone through `change(entry) -> message or None`."""
    head = read_metadata(path)
    with RecordingWriter(out, head.metadata, head.attachments) as writer:
        for entry in read_recording(path):
            message = change(entry)
            if message is not None:
                writer.add_message(entry.key, message, entry.received_t_ns)
    return out


def without(path: Path, is_gone: Callable[[Envelope], bool]) -> Path:
    """A copy beside it, under another name, without some of its messages."""
    out = path.with_name(f"without-{secrets.token_hex(4)}.mcap")
    return changed(path, out, lambda entry: None if is_gone(entry) else entry.message)


def without_topics(path: Path, out: Path, *topics: str) -> Path:
    """A copy as a recorder makes it that leaves these topics out."""
    head = read_metadata(path)
    with RecordingWriter(out, {**head.metadata, "left_out": ",".join(topics)}, head.attachments) as writer:
        for entry in read_recording(path):
            if entry.topic not in topics:
                writer.add(entry)
    return out


def remade(lean: Path, whole: Path) -> Comparison:
    """What a replay of the recording `lean` makes, compared with the scores and alarms of the recording `whole`."""
    with open_replay_input([lean], None, (), None) as given, open_replay_input([whole], None, (), None) as wanted:
        (tray,) = given.trays
        plan, recorded_alarms, why_not_verified = given.read_plan(tray.name)
        assert not why_not_verified
        pipeline = given.pipeline(tray.name, plan)
        verifier = TrayVerifier(tray.name, lambda topic: wanted.envelopes(tray.name, (topic,)), pipeline.limit_of)
        alarms: list[Alarm] = []
        for producer, message in pipeline.run():
            if isinstance(message, Alarm):
                alarms.append(replace(message, header=Header(producer, 0, tray.name)))
            elif isinstance(message, Score):
                verifier.add(producer, message)
        return verifier.finish(plan.last, alarms, recorded_alarms)


def recording_of(
    folder: Path, seed: int, *samples: int, raw_samples: int = 1, killed: str = "", calibrated: bool = False
) -> Path:
    """A recording of so many samples, with a stage killed after each number of them but the last."""
    site = Site(folder, seed, raw_samples, calibrated=calibrated)
    for number, count in enumerate(samples):
        if number:
            site.kill(killed)
        site.run(count)
    return site.finished()


def alarms_of(path: Path) -> list[Alarm]:
    return recorded(path, "alarm")
