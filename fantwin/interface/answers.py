"""The answer to a table or a recording: what the pipeline decides on it, as a table of the same library."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from fantwin.interface.columns import Fan
from fantwin.interface.decisions import DecidedTray, decided
from fantwin.interface.suspicions import suspect_levels
from fantwin.interface.tables import Array, FanTable, Form, data_frame
from fantwin.interface.words import Words
from fantwin.pipeline.extras import is_installed
from fantwin.pipeline.learning.evaluation import evaluated
from fantwin.pipeline.learning.training_data import Part
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.recordings.dates import has_date
from fantwin.pipeline.recordings.raw_recordings import write_table
from fantwin.pipeline.replay.offline.healthy_runs import in_this_process
from fantwin.pipeline.sources.tables.measured_table import Table
from fantwin.schemas.tacho import Tacho

Answer: TypeAlias = Literal["prediction", "scores", "alarms"]
MOST_KEPT = 2_000_000
"""samples of fans of a table whose scores are kept, some 300 MB"""


def of_table(
    given: FanTable,
    twin: Path,
    overrides: Sequence[str],
    answer: Answer,
    latest: dict[str, DecidedTray],
    words: Words,
) -> Any:
    """The answer to a table.

    latest: the scores of the newest table by its samples: `score` and `alarms` of one table take the time of one.
    """
    loaded, key = load_tray_twin(twin, len(given.fans)), _digest(given.samples, overrides)
    tray = latest.get(key) if answer != "prediction" else None
    if tray is None:
        recording = recording_of(given, loaded.card.tacho, twin)
        (tray,) = decided(recording, twin, overrides, words, scores=answer != "prediction")
        if answer != "prediction":
            latest.clear()
            if given.samples.command.size <= MOST_KEPT:
                latest[key] = tray
    suspect_levels(given, loaded, tray.scores)
    words.warn(tray.left_out)
    return given.form.make(_columns(tray, given.fans, given.form, answer), given.form.zone)


def recording_of(given: FanTable, tachos: tuple[Tacho, ...], twin: Path) -> Path:
    """A recording of a table, beside the file of the twin."""
    recording = twin.with_name("table.mcap")
    write_table(given.samples, recording, "table", tachos)
    return recording


def evaluation_of(recording: Path, twin: Path, words: Words) -> dict[str, Any]:
    """The fields of `fantwin evaluate --json`, with the fans and the words of the caller's table."""
    found, damage = evaluated(twin, [recording], Part(), in_this_process)
    words.warn(damage)
    found |= {"headline": words.of(found["headline"]), "warnings": [words.of(line) for line in found["warnings"]]}
    for fan, name in zip(found["fans"], words.fans, strict=False):
        fan["fan"] = name
    return found


def of_recording(recording: Path, twin: Path, overrides: Sequence[str], answer: Answer, words: Words) -> Any:
    """The answer to a recording: its trays one after another, with a column `tray`."""
    trays = decided(recording, twin, overrides, words, scores=answer != "prediction")
    for tray in trays:
        words.warn(tray.left_out)
    is_dated = any(has_date(int(tray.scores[0].t_ns[0])) for tray in trays if tray.scores)
    form = Form(_frame_or_dict, "dates" if is_dated else "seconds", unit=trays[0].speed_unit)
    parts = [_columns(tray, range(tray.fans), form, answer) for tray in trays]
    names = np.repeat(np.array([tray.name for tray in trays], np.object_), [len(part["fan"]) for part in parts])
    return form.make(
        {"tray": names} | {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, None
    )


def _columns(tray: DecidedTray, fans: Sequence[Fan], form: Form, answer: Answer) -> dict[str, Array]:
    if answer == "alarms":
        return tray.columns_of_alarms(fans, form)
    return tray.columns_of_samples(fans, form, decisions=answer == "scores")


def _digest(samples: Table, overrides: Sequence[str]) -> str:
    found = hashlib.sha256(repr(overrides).encode())
    for name, values in {
        "t": samples.t_ns,
        "c": samples.command,
        "s": samples.speed_rad_s,
        **samples.auxiliary,
    }.items():
        found.update(name.encode() + np.ascontiguousarray(values).tobytes())
    return found.hexdigest()


def _frame_or_dict(columns: dict[str, Array], zone: Any) -> Any:
    if not is_installed("pandas"):
        return columns
    import_module("pandas")
    return data_frame(columns, zone)
