"""Recordings in parts, as a recorder writes them, and alarm clips of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from fantwin.pipeline.recordings import disk_room
from fantwin.pipeline.recordings.clips.alarm_clips import AlarmClips
from fantwin.pipeline.recordings.clips.clip import Clip, ClipAlarm
from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.recordings.recorder import Recorder
from fantwin.pipeline.recordings.recorder_config import RecorderConfig
from fantwin.schemas.codec import encode
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Alarm
from tests.support.stub_disk import uncut_clips

S = 1_000_000_000


def record(
    source: Path,
    recording: Path,
    left_out: Iterable[str] = (),
    clips: AlarmClips | None = None,
    part_s: float = disk_room.PART_S,
    **config: Any,
) -> Recorder:
    """A recorder that has been given all messages of `source` at their times, and goes on."""
    head, leaves_out = read_metadata(source), tuple(left_out)
    metadata = {**head.metadata, **({"left_out": ",".join(leaves_out)} if leaves_out else {})}
    parts = RecordingParts(recording, metadata, head.attachments, session="s1")
    envelopes = [each for each in read_recording(source) if each.topic not in leaves_out]
    core = Recorder(
        parts, RecorderConfig(**config), envelopes[0].received_t_ns, clips or uncut_clips(recording), leaves_out
    )
    ticked_ns = 0
    with patch.object(disk_room, "PART_S", part_s):
        for envelope in envelopes:
            core.step(envelope)
            if envelope.received_t_ns - ticked_ns >= S // 20:
                ticked_ns = envelope.received_t_ns
                core.tick(ticked_ns)
        core.tick(envelopes[-1].received_t_ns + S)  # flushes
    return core


def clip_of(alarm: Alarm, before_s: float, after_s: float) -> Clip:
    """A clip whose scorer continues from a snapshot of before its beginning."""
    since_ns, until_ns = alarm.t_ns - round(before_s * S), alarm.t_ns + round(after_s * S)
    alarms = (ClipAlarm(alarm.fan, alarm.onset_t_ns, alarm.t_ns),)
    return Clip("clip.mcap", alarm.header.tray, since_ns, until_ns, since_ns, alarms)


def of_tray(envelope: Envelope, tray: str) -> Envelope:
    """The same message of another tray."""
    message = replace(envelope.message, header=replace(envelope.message.header, tray=tray))
    key = envelope.key.replace("/tray1/", f"/{tray}/")
    return Envelope(key, envelope.topic, encode(message), envelope.received_t_ns, message)
