"""The answer to a table or a recording: what the pipeline decides on it, as a table of the same library."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from fantwin.interface.columns import Fan
from fantwin.interface.decisions import DecidedTray, decided
from fantwin.interface.suspicions import refuse_speeds
from fantwin.interface.tables import Array, FanTable, Form, data_frame
from fantwin.pipeline.extras import is_installed
from fantwin.pipeline.recordings.dates import has_date
from fantwin.pipeline.recordings.raw_recordings import write_table
from fantwin.schemas.tacho import Tacho

Answer: TypeAlias = Literal["prediction", "scores", "alarms"]


def of_table(given: FanTable, tachos: tuple[Tacho, ...], twin: Path, overrides: Sequence[str], answer: Answer) -> Any:
    """The answer to a table, which becomes a recording beside the file of the twin."""
    recording = twin.with_name("table.mcap")
    write_table(given.samples, recording, "table", tachos)
    (tray,) = decided(recording, twin, overrides)
    refuse_speeds(tray.scores, given.form.unit)
    return given.form.make(_columns(tray, given.fans, given.form, answer), given.form.zone)


def of_recording(recording: Path, twin: Path, overrides: Sequence[str], answer: Answer) -> Any:
    """The answer to a recording: its trays one after another, with a column `tray`."""
    trays = decided(recording, twin, overrides)
    is_dated = any(has_date(int(tray.scores[0].t_ns[0])) for tray in trays if tray.scores)
    form = Form(_frame_or_dict, is_dated, unit=trays[0].speed_unit)
    parts = [_columns(tray, range(tray.fans), form, answer) for tray in trays]
    names = np.repeat(np.array([tray.name for tray in trays], np.object_), [len(part["fan"]) for part in parts])
    return form.make(
        {"tray": names} | {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, None
    )


def _columns(tray: DecidedTray, fans: Sequence[Fan], form: Form, answer: Answer) -> dict[str, Array]:
    if answer == "alarms":
        return tray.columns_of_alarms(fans, form)
    return tray.columns_of_samples(fans, form, decisions=answer == "scores")


def _frame_or_dict(columns: dict[str, Array], zone: Any) -> Any:
    if not is_installed("pandas"):
        return columns
    import_module("pandas")
    return data_frame(columns, zone)
