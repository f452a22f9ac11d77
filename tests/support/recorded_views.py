"""The same ten seconds as a viewer shows them live, as a recording, and as the view of that recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fantwin.pipeline.cli.options import ViewLayout
from fantwin.pipeline.cli.recordings.view import view
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.messages import Alarm, Message, Score
from fantwin.stages.viewer import build
from tests.support.drawn_views import context, sent
from tests.support.score_data import START_NS, made_up_tray
from tests.support.small_recordings import key_of
from tests.support.wear_data import worn_snapshot

HOLE_S = (4.0, 6.0)


def messages() -> list[Message]:
    """Ten seconds of three fans with all that a view shows: an alarm, a hole, temperatures and wear."""
    scores, alarms = made_up_tray(seconds=10, fault_s=(6.5, 8.0))
    seen = [s for s in scores if not HOLE_S[0] <= (s.t_ns[0] - START_NS) / 1e9 < HOLE_S[1]]
    warm = [replace(s, temperature_c=np.full(s.score.shape, 21.0, np.float32)) for s in seen]
    alarms = [replace(alarm, header=replace(alarm.header, sequence=n)) for n, alarm in enumerate(alarms)]
    return [worn_snapshot("tray1", 3, 2, START_NS), *sorted([*warm, *alarms], key=last_t_ns)]


def last_t_ns(message: Score | Alarm) -> int:
    return int(np.max(message.t_ns))


def live_view(folder: Path) -> Path:
    """What the stage writes while messages come one by one."""
    core = build(context(folder)).core
    for number, message in enumerate(messages()):
        core.step(sent(message))
        core.tick(START_NS + number * 37_000_000)
    core.close()
    return folder / "view.rrd"


def recording(folder: Path) -> Path:
    metadata = {"site": "site", "trays": "tray1", "fans.tray1": "3", "speed_unit.tray1": "rad/s"}
    with RecordingWriter(folder / "rec.mcap", metadata, {}) as writer:
        for number, message in enumerate(messages()):
            writer.add_message(key_of(message, "site"), message, START_NS + number * 100_000_000)
    return writer.path


def recorded_view(folder: Path, layout: str = "all") -> Path:
    folder.mkdir(exist_ok=True)
    view([recording(folder)], folder / "recorded.rrd", ViewLayout(layout), json_output=True)
    return folder / "recorded.rrd"
