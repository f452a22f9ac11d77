"""Measured data with labelled faults, the rosa rig (docs/how-to/datasets.md), evaluated as by a first-time user.

`fantwin import`, `train`, `calibrate` and `replay --offline --json`, nothing else, and healthy runs alone decide on
twins and limits. Healthy runs are held out in turn: of the others every second one by speed trains, and the rest
calibrates. Faulty runs are scored by each of these twins. An event is a stretch of rows that `Binary Macro Health Mode`
calls anomalous; stretches less than a second apart are one.
"""

from __future__ import annotations

import io
import json
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd

from bench.detection.competitors import FilteredBalance, fitted_balance, plain_methods
from bench.detection.libraries import library_methods
from bench.detection.methods import Calibration, Log, Method
from bench.detection.metrics import (
    Event,
    Outcome,
    RaisedAlarm,
    false_alarms,
    outcomes,
    rate,
    vus_pr,
)
from bench.detection.ours import NAME
from fantwin.pipeline.cli.main import main as fantwin
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.schemas.messages import Array, Prediction, Score

FOLDER = Path(os.environ.get("FANTWIN_DATA", Path(__file__).parents[3] / "shared" / "data")) / "rosa"
COLUMNS = ("--time", "Time:ms", "--command", "Shaft Control Effort", "--speed", "Actual Speed:rpm")
LABEL, ANOMALOUS = "Binary Macro Health Mode", "A"
ALARMS_PER_HOUR = 2.0
MOST_FOLDS = 8
JOINED_NS = 1_000_000_000
LONGEST_BUFFER_S, BUFFERS = 2.0, 11
REFERENCE = "filtered balance"
Progress = Callable[[str], None]
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Measured:
    """A run of the rig: its recording, its events, and how fast it turned on average."""

    name: str
    kind: str
    recording: Path
    events: tuple[Event, ...]
    speed: float

    @property
    def is_healthy(self) -> bool:
        """Whether it was recorded as such."""
        return self.kind == "healthy"


@dataclass
class Scored:
    """The results of a method: alarms, scores and scored hours of each run."""

    alarms: dict[str, list[RaisedAlarm]] = field(default_factory=dict)
    scores: dict[str, tuple[Array, Array]] = field(default_factory=dict)
    """by run: t_ns (n,) and score (n,)"""
    hours: dict[str, float] = field(default_factory=dict)


@dataclass
class Tally:
    """The results of a method over all folds."""

    false: list[RaisedAlarm] = field(default_factory=list)
    healthy_hours: float = 0.0
    beside_events: int = 0
    found: list[Outcome] = field(default_factory=list)
    volumes: list[float] = field(default_factory=list)


def measured_tables(progress: Progress, *, libraries: bool) -> tuple[dict[str, Rows], list[str]]:
    """The tables of the rig, and notes on them. Exits with a message if the data are missing."""
    if not FOLDER.is_dir():
        raise SystemExit(
            f"{FOLDER}: not there; set FANTWIN_DATA to the folder of measured sets (docs/how-to/datasets.md)"
        )
    tallies: dict[str, Tally] = {}
    with tempfile.TemporaryDirectory() as folder:
        runs = imported(FOLDER, Path(folder))
        for number, (training, calibrating, held_out) in enumerate(folds(runs)):
            names = ", ".join(run.name for run in held_out)
            progress(
                f"rosa {number + 1}: held out {names}; trained on {len(training)}, calibrated on {len(calibrating)}"
            )
            place = Path(folder) / f"fold{number}"
            place.mkdir()
            scored = scored_fold(place, training, calibrating, held_out, runs, libraries=libraries)
            for name, one in scored.items():
                add_scored(tallies.setdefault(name, Tally()), one, held_out, runs)
    minutes = next(iter(tallies.values())).healthy_hours * 60
    return {
        "rosa: false alarms on held-out healthy runs; events found, and the median delay": [
            _row(name, one) for name, one in tallies.items()
        ],
        "rosa: each event, by twins of how many folds it is found": _event_rows(tallies),
    }, [
        f"rosa: every healthy run was held out once, {minutes:.1f} min scored",
        "rosa: one false alarm in half an hour is declared; calibrated on healthy runs of a sixth of that time",
        *(f"rosa: fantwin, false alarm: {one.run} at {one.raised_ns / 1e9:.2f} s" for one in tallies[NAME].false),
        "rosa: 'beside' are alarms of faulty runs outside of their events and the 5 s after them",
    ]


def imported(folder: Path, place: Path) -> list[Measured]:
    """All runs of the folder, as recordings."""
    runs = []
    for table in sorted(folder.glob("*.csv")):
        recording = place / f"{table.stem}.mcap"
        _fantwin("import", table, *COLUMNS, "-o", recording)
        columns = pd.read_csv(table, encoding="utf-8-sig").rename(columns=str.strip)
        t_ns = np.asarray(columns["Time"], np.int64) * 1_000_000
        is_anomalous = np.array([label.strip() == ANOMALOUS for label in columns[LABEL]])
        kind = table.stem.partition("_")[0]
        speed = float(np.mean(np.abs(np.asarray(columns["Actual Speed"], np.float64))))
        runs.append(Measured(table.stem, kind, recording, events(table.stem, kind, t_ns, is_anomalous), speed))
    return runs


def events(run: str, kind: str, t_ns: Array, is_anomalous: Array) -> tuple[Event, ...]:
    """The stretches of anomalous rows, those less than a second apart joined."""
    times = np.sort(t_ns[is_anomalous])
    if not len(times):
        return ()
    cuts = np.flatnonzero(np.diff(times) > JOINED_NS) + 1
    return tuple(Event(run, 0, int(part[0]), int(part[-1]), kind) for part in np.split(times, cuts))


def folds(runs: Sequence[Measured]) -> list[tuple[list[Measured], list[Measured], list[Measured]]]:
    """Healthy runs to train on, to set limits by, and held out; each is held out once."""
    healthy = sorted((run for run in runs if run.is_healthy), key=lambda run: run.speed)
    count = min(MOST_FOLDS, len(healthy))
    made = []
    for number in range(count):
        rest = [run for place, run in enumerate(healthy) if place % count != number]
        made.append((rest[0::2], rest[1::2], healthy[number::count]))
    return made


def scored_fold(
    place: Path,
    training: Sequence[Measured],
    calibrating: Sequence[Measured],
    held_out: Sequence[Measured],
    runs: Sequence[Measured],
    *,
    libraries: bool,
) -> dict[str, Scored]:
    """Train and calibrate on healthy runs, and score those held out and the faulty ones by every method."""
    twin = place / "rosa.onnx"
    healthy = [run.recording for run in calibrating]
    train_twin(training, twin)
    _fantwin("calibrate", twin, *healthy, "--false-alarms-per-day", 24 * ALARMS_PER_HOUR, "--extrapolate")
    judged_runs = [*held_out, *(run for run in runs if not run.is_healthy)]
    ours = Scored()
    blocks: dict[str, list[Prediction]] = {}
    for run in judged_runs:
        blocks[run.name] = _score(run, twin, place, ours)
    for run in (*training, *calibrating):
        blocks[run.name] = _score(run, twin, place, Scored())
    rate_hz = 1e9 / blocks[training[0].name][0].period_ns
    learned = [blocks[run.name] for run in training]
    coefficients = fitted_balance(learned)
    methods = [
        Method(REFERENCE, lambda _: FilteredBalance(coefficients)),
        *plain_methods(rate_hz, ALARMS_PER_HOUR),
        *(library_methods(rate_hz, learned, few_fans=False) if libraries else ()),
    ]
    found = {NAME: ours}
    for method in methods:
        if not method.is_fixed:
            method.limit = _limit(method, [blocks[run.name] for run in calibrating])
        found[method.name] = Scored()
        for run in judged_runs:
            _watch(method, run.name, blocks[run.name], found[method.name])
    return found


def train_twin(training: Sequence[Measured], twin: Path) -> None:
    """Write the twin that some runs train."""
    _fantwin("train", *(run.recording for run in training), "--model", "physical", "--command-unit", "%", "-o", twin)


def _score(run: Measured, twin: Path, place: Path, scored: Scored) -> list[Prediction]:
    """Add the alarms and scores of fantwin for a run; returns its predictions, for the other methods."""
    written = place / f"{run.name}.mcap"
    result = json.loads(_fantwin("replay", run.recording, "--offline", "--twin", twin, "--json", "-o", written))
    scored.alarms[run.name] = [
        RaisedAlarm(
            run.name, one["fan"], one["raised_ns"], one["cleared_ns"], tuple(cause["cause"] for cause in one["causes"])
        )
        for one in result["alarms"]
    ]
    scored.hours[run.name] = result["hours"]
    predictions: list[Prediction] = []
    scores: list[Score] = []
    for entry in read_recording(written, ("prediction", "score")):
        if isinstance(entry.message, Prediction):
            predictions.append(entry.message)
        elif isinstance(entry.message, Score):
            scores.append(entry.message)
    scored.scores[run.name] = (
        np.concatenate([one.t_ns for one in scores]),
        np.concatenate([one.score[:, 0] for one in scores]),
    )
    written.unlink()
    return predictions


def _limit(method: Method, healthy: Sequence[Sequence[Prediction]]) -> float:
    calibration = Calibration(ALARMS_PER_HOUR)
    for number, run in enumerate(healthy):
        scores = method.scores(1)
        for block in run:
            calibration.take(str(number), block, scores.take(block))
    return calibration.limit()


def _watch(method: Method, run: str, blocks: Sequence[Prediction], scored: Scored) -> None:
    detector, log = method.detector(1), Log()
    scores = []
    for block in blocks:
        output = detector.take(block)
        log.take(run, output.changes)
        scores.append(output.score[:, 0])
    score = np.concatenate(scores)
    scored.alarms[run] = log.alarms
    scored.scores[run] = (np.concatenate([block.t_ns for block in blocks]), score)
    scored.hours[run] = float(np.isfinite(score).sum()) * blocks[0].period_ns / 3.6e12


def add_scored(tally: Tally, scored: Scored, held_out: Sequence[Measured], runs: Sequence[Measured]) -> None:
    """Add the results of a fold."""
    for run in held_out:
        tally.false += scored.alarms[run.name]
        tally.healthy_hours += scored.hours[run.name]
    for run in runs:
        if run.is_healthy:
            continue
        alarms = scored.alarms[run.name]
        tally.found += outcomes(run.events, alarms)
        tally.beside_events += len(false_alarms(alarms, run.events))
        t_ns, score = scored.scores[run.name]
        anomalous = np.zeros(len(t_ns), np.bool_)
        for event in run.events:
            anomalous |= (t_ns >= event.start_ns) & (t_ns <= event.end_ns)
        if anomalous.any():
            longest = LONGEST_BUFFER_S * 1e9 / float(np.median(np.diff(t_ns)))
            tally.volumes.append(vus_pr(anomalous, score, np.linspace(0, longest, BUFFERS).astype(int).tolist()))


def _row(name: str, tally: Tally) -> dict[str, Any]:
    kinds = sorted({one.event.kind for one in tally.found})
    return {
        "method": name,
        "false an hour (95 %)": f"{len(tally.false)}: {rate(len(tally.false), tally.healthy_hours)}",
        **{kind: _found([one for one in tally.found if one.event.kind == kind]) for kind in kinds},
        "beside": str(tally.beside_events),
        "VUS-PR": f"{np.mean(tally.volumes):.3f}",
    }


def _event_rows(tallies: dict[str, Tally]) -> Rows:
    rows: dict[Event, dict[str, Any]] = {}
    for name in (NAME, REFERENCE):
        found: dict[Event, list[Outcome]] = {}
        for one in tallies[name].found:
            found.setdefault(one.event, []).append(one)
        for event, of in found.items():
            row = rows.setdefault(event, {"run": event.run, "lasts": f"{(event.end_ns - event.start_ns) / 1e9:.1f} s"})
            row[name] = _found(of)
            if name == NAME:
                causes = Counter(one.cause for one in of if one.cause)
                row["reported first"] = ", ".join(f"{cause} {count}" for cause, count in causes.most_common(3))
    return list(rows.values())


def _found(found: Sequence[Outcome]) -> str:
    hits = [one.delay_s for one in found if one.is_found]
    delay = f", {np.median(hits):.2f} s" if hits else ""
    return f"{len(hits)} of {len(found)}{delay}"


def _fantwin(*words: object) -> str:
    """Run a command in this process, so that it decides as `without` says; what it printed. Ends the program where it
    could not be done."""
    printed, said = io.StringIO(), io.StringIO()
    arguments = ["fantwin", *map(str, words)]
    with patch.object(sys, "argv", arguments), redirect_stdout(printed), redirect_stderr(said):
        try:
            fantwin()
            code = 0
        except SystemExit as end:
            code = end.code
    if code not in (0, 3, None):
        raise SystemExit(f"fantwin {words[0]} ended with {code}: {said.getvalue().strip()}")
    return printed.getvalue()
