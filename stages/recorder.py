"""Recorder: writes the messages on the bus to MCAP files.

Reads   every topic marked as recorded in schemas/topics.py, of all trays, and the health of all stages; of the topics
        of samples those of `topics`, by default only raw samples
Writes  nothing on the bus; a recording of one or more parts, docs/reference/recordings.md
Units   as in the messages: their bytes are not changed
Timing  a message survives a crash, also of the machine, at most two minutes after its receipt; earlier if much is
        received, or if something happens. Health messages are recorded if they report something new
"""

from __future__ import annotations

import logging
import os
import secrets
import shutil
from contextlib import suppress

from fantwin.pipeline.config.registry import RECORDER, STAGES
from fantwin.pipeline.recordings.clips.alarm_clips import AlarmClips
from fantwin.pipeline.recordings.clips.clip import clips_in, list_path
from fantwin.pipeline.recordings.clips.cutting import ClipCutter
from fantwin.pipeline.recordings.clips.tracker import ClipTracker
from fantwin.pipeline.recordings.disk import DiskError, least_free_bytes
from fantwin.pipeline.recordings.metadata import recording_metadata
from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.reading import LEFT_OUT_KEY, RecordingError
from fantwin.pipeline.recordings.recorder import Recorder
from fantwin.pipeline.recordings.recorder_config import CLIPS_SHARE, LONGEST_FLUSH_S, RecorderConfig, recorded_topics
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Stage, StageError
from fantwin.schemas.topics import tray_key

_ROW = STAGES[RECORDER]
KEEPS = _ROW.keeps
"""topics whose last messages it keeps for others, also from recordings of before its start"""
_LOG = logging.getLogger(__name__)


def build(context: Context) -> BuiltStage:
    """Repair what a killed recorder left, and begin the first part.

    Raises:
        StageError: it cannot be written there.
    """
    config: RecorderConfig = context.config
    metadata, attachments = recording_metadata(context)
    metadata["flush_interval_s"] = f"{LONGEST_FLUSH_S:g}"
    reads = STAGE.reads if context.reads is None else context.reads
    left_out = tuple(name for name in STAGE.reads if name not in reads)
    if left_out:
        metadata[LEFT_OUT_KEY] = ",".join(left_out)
    try:
        parts = RecordingParts(context.own_file(config.file), metadata, attachments, session=secrets.token_hex(4))
        for line in parts.remarks:
            _LOG.warning("%s", line)
        own = {tray_key(context.site, tray.name, topic) for tray in context.trays for topic in KEEPS}
        kept = {key: last for topic in KEEPS for key, last in parts.last_messages(topic).items() if key in own}
        clips = _clips_of(parts, config)
        return BuiltStage(Recorder(parts, config, context.started_t_ns, clips, left_out), kept=kept)
    except RecordingError as error:
        raise StageError(f"{error} (recorder.file)") from error


def _clips_of(parts: RecordingParts, config: RecorderConfig) -> AlarmClips:
    disk_bytes = 0
    with suppress(DiskError):  # it does not say its size: the health reports that
        disk_bytes = parts.disk_bytes()
    most_bytes = round(disk_bytes * config.keep_share_of_disk * CLIPS_SHARE)
    tracker = ClipTracker(clips_in(list_path(parts.path)), most_bytes, kept_s=86_400 * config.keep_days)
    cutter = ClipCutter(parts.path, parts.free_bytes, lambda: least_free_bytes(parts.disk_bytes()))
    return AlarmClips(tracker, parts.path, cutter.cut)


def check(context: Context) -> list[str]:
    """Problems with the folder: it cannot be written, or its disk is too full."""
    folder = context.own_file(context.config.file).parent
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if not (existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)):
        return [f"{folder}: {existing} is not a folder that this user can write to; change run_folder or recorder.file"]
    usage = shutil.disk_usage(existing)
    if usage.free < (wanted := least_free_bytes(usage.total)):
        return [
            f"{folder}: {usage.free / 1e6:,.1f} MB are free, but nothing is recorded below {wanted / 1e6:,.1f} MB: "
            "make room"
        ]
    return []


STAGE = Stage(
    row=_ROW,
    about="records what a site sends, with configuration and twin, in MCAP files",
    config=RecorderConfig,
    build=build,
    core_per_tray=False,
    wants_envelopes=True,
    is_patient=True,
    check=check,
    chooses=recorded_topics,
)
