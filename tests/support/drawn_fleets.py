"""A viewer of three trays of which one fan raises an alarm, and the messages that it is fed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fantwin.pipeline.outputs.rerun.viewer_core import ViewerCore
from fantwin.pipeline.runtime.stage import Context
from fantwin.schemas.messages import Alarm, Score
from tests.support import drawn_views
from tests.support.drawn_views import sent
from tests.support.score_data import made_up_tray

TRAYS = ("tray1", "tray2", "tray3")


def messages_of(seconds: float = 20.0, **of_tray: Any) -> list[Score | Alarm]:
    """Messages of three trays by time; fan 2 of tray2 is in alarm from 8.5 to 14.5 s. of_tray: for `made_up_tray`."""
    found: list[Score | Alarm] = []
    for tray in TRAYS:
        options = {"faulty_fan": 2 if tray == "tray2" else None, "gap_fan": None}
        scores, alarms = made_up_tray(tray=tray, seconds=seconds, **{**options, **of_tray})
        found += [*scores, *alarms]
    return sorted(found, key=last_t_ns)


def last_t_ns(message: Any) -> int:
    return int(message.t_ns[-1]) if isinstance(message, Score) else message.t_ns


def play(core: ViewerCore, messages: list[Score | Alarm]) -> None:
    """Hand over messages, each with a tick after it, at the time of its last sample."""
    for message in messages:
        core.step(sent(message))
        core.tick(last_t_ns(message))


def context(folder: Path, trays: int, fans: int, **config: Any) -> Context:
    return drawn_views.context(folder, fans=fans, trays=TRAYS[:trays], **config)
