"""The next version of a learned twin, from the healthy history of its tray.

A new twin is trained on recordings before the newest and compared over the newest with the twin in force. Unless it is
clearly better, the new version is the twin in force with new limits. Where the fans have changed more than healthy fans
do, the new version is offered to the operator and not taken.
"""

from __future__ import annotations

import hashlib
import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from pipeline.cli.twins.calibrate import calibrate
from pipeline.cli.twins.drops_found import drops_found
from pipeline.cli.twins.train import train
from pipeline.cli.twins.training_data import TrainingData, read_training_data, twin_errors
from pipeline.errors import UserError
from pipeline.learning.healthy_history import Stretch, stretches
from pipeline.learning.versions import Drop, Outcome, TwinVersions, Version
from pipeline.recordings.runs import read_runs
from pipeline.runtime.tray_twin import load_tray_twin
from schemas.units import NS_PER_S
from scoring.calibration.calibration import too_little
from scoring.limits import Limits

if TYPE_CHECKING:
    from schemas.messages import Array

MOST_TRAINING_SAMPLES = 10_000
"""of a fan: so many are enough for small networks, and take a minute or two"""
WANTED_S = 24 * 3600.0
"""of healthy running that limits are from, unless the declared rate takes more; an hour takes about ten seconds"""
MOST_RECORDINGS = 24
"""the newest ones that a twin is trained on"""
MARGIN = 1.3
"""not all of it can be scored"""
HELD_OUT = 0.2
"""share of the only stretch that a first twin is not trained on"""
BETTER = 0.98
"""times the error of the twin in force: a new one must be below it"""
COMMISSIONED_S = 24 * 3600.0
"""of healthy running: a version that learned from less is no reference yet, and all that it learns from is taken for
healthy"""
MOST_CHANGE = 0.03
"""of the speed of a fan since the reference: about a seventh of the speed that a blocked inlet or a lost blade takes"""


@dataclass(frozen=True)
class _Part:
    """A part of each of some recordings, in seconds since its first sample."""

    paths: list[Path]
    from_s: float
    to_s: float


def make_next_version(folder: Path, tray: str, per_day: float, say: Callable[[str], None]) -> Version:
    """Make the next version and add it to the list; it is in force if it was taken.

    per_day: false alarms of a fan to declare. say: called with a progress line for each step.

    Raises:
        UserError: there is nothing to learn from, or too little; a file cannot be read or written.
    """
    versions = TwinVersions(folder, tray)
    history = stretches(folder, versions.not_learned())
    if not history:
        raise UserError(f"{folder}: no healthy history to learn from yet")
    before, name = versions.in_force(), versions.next_name()
    with tempfile.TemporaryDirectory(prefix="learning-", dir=folder) as place:
        work = _Work(Path(place), name, versions, history, before, per_day, say)
        version, content = work.version()
    unfinished = folder / f"{name}.onnx.new"
    try:
        unfinished.write_bytes(content)
        unfinished.replace(versions.file(name))
    except OSError as error:
        raise UserError(f"{versions.file(name)}: cannot be written: {error.strerror}") from error
    versions.add(version)
    return version


@dataclass(frozen=True)
class _Split:
    training: _Part
    test: _Part


class _Work:
    def __init__(
        self,
        place: Path,
        name: str,
        versions: TwinVersions,
        history: Sequence[Stretch],
        before: Version | None,
        per_day: float,
        say: Callable[[str], None],
    ) -> None:
        self._place, self._name, self._versions = place, name, versions
        self._history, self._before, self._per_day, self._say = history, before, per_day, say
        rate_hz, fans = _rate_hz(history[-1])
        self._most_training_s = MOST_TRAINING_SAMPLES / rate_hz
        needed_s = 3600.0 * too_little(0.0, per_day).needed_fan_hours / fans
        self._limits_from = newest(history, max(WANTED_S, MARGIN * needed_s))

    def version(self) -> tuple[Version, bytes]:
        """The version and the content of its file."""
        split, before = _split(self._history, self._most_training_s), self._before
        if before is None:
            trained = self._trained(split)
            return self._made(trained, "trained", _data(split.test), "taken", "the first one")
        test, in_force = _data(split.test), self._versions.file(before.name)
        reference = next(version for version in self._versions.all() if version.name == before.reference)
        if _learned_s(reference) < COMMISSIONED_S:
            reference = None
        elif moved := self._moved(reference, test):
            self._limits_from = self._history[-1:]
            split = _split(self._limits_from, self._most_training_s)
            return self._made(self._trained(split), "trained", _data(split.test), "offered", moved)
        trained = self._trained(split)
        error, error_before = _error(trained, test), _error(in_force, test)
        compared = f"error {error:.3g} {test.speed_unit}, that of {before.name} {error_before:.3g}"
        if error < BETTER * error_before:
            return self._made(trained, "trained", test, "taken", compared, reference)
        return self._made(
            in_force,
            "new limits",
            test,
            "taken",
            f"a newly trained twin is less than 2 % better: {compared}",
            reference,
        )

    def _moved(self, reference: Version, test: TrainingData) -> str:
        """What has changed since the reference more than healthy fans do, in words; empty if nothing has."""
        change = _mean_change(self._versions.file(reference.name), test) - np.array(reference.change)
        return changed_fans(change, reference.name)

    def _made(
        self,
        twin: Path,
        how: Literal["trained", "new limits"],
        test: TrainingData,
        outcome: Outcome,
        why: str,
        reference: Version | None = None,
    ) -> tuple[Version, bytes]:
        """The version of a twin, with limits. reference: None: itself."""
        is_offered = outcome == "offered"
        limited = self._with_limits(twin, test)
        assert limited.limits.declared_rate
        change = _mean_change(self._versions.file(reference.name) if reference else twin, test)
        return Version(
            name=self._name,
            how=how,
            made_t_ns=self._history[-1].period[1],
            hours=sum(each.seconds for each in self._limits_from) / 3600.0,
            periods=tuple(each.period for each in (self._limits_from if is_offered else self._history)),
            since_t_ns=self._history[-1].period[0] if is_offered else self._before.since_t_ns if self._before else 0,
            speed_unit=test.speed_unit,
            error=_error(twin, test),
            change=tuple(change.tolist()),
            reference=reference.name if reference else self._name,
            drops=limited.drops,
            declared_per_day=self._per_day,
            is_target=limited.limits.declared_rate.extrapolated,
            outcome=outcome,
            why=why,
            sha256=hashlib.sha256(limited.file).hexdigest(),
        ), limited.file

    def _trained(self, split: _Split) -> Path:
        """A newly trained twin, without limits."""
        part, test = split.training, split.test
        twin = self._place / f"{self._name}.onnx"
        self._say(f"{self._name}: training")
        with _quietly():
            train(
                part.paths,
                twin,
                validate=test.paths,
                from_s=part.from_s,
                to_s=part.to_s,
                validate_from_s=test.from_s,
                validate_to_s=test.to_s,
                name=self._name,
            )
        return twin

    def _with_limits(self, twin: Path, test: TrainingData) -> _WithLimits:
        limits_from = self._limits_from
        named, done = self._place / "named.onnx", self._place / "limits.onnx"
        with twin_errors():
            from twin.export.card_entries import with_card_entries  # noqa: PLC0415  as in _residual

            named.write_bytes(with_card_entries(twin.read_bytes(), {"name": self._name}))
        self._say(f"{self._name}: limits from {_hours(sum(each.seconds for each in limits_from))} of healthy running")
        with _quietly():
            calibrate(named, [each.path for each in limits_from], self._per_day, extrapolate=True, output=done)
        calibration = load_tray_twin(done).card.calibration
        drops = tuple(
            Drop(speed=drop.speed, at_once=_finite(drop.at_once), within_a_minute=_finite(drop.within_a_minute))
            for drop in drops_found(done, test.rad_s_per_unit)
        )
        return _WithLimits(done.read_bytes(), Limits.model_validate(calibration), drops)


@dataclass(frozen=True)
class _WithLimits:
    file: bytes
    limits: Limits
    drops: tuple[Drop, ...]


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _split(history: Sequence[Stretch], most_s: float) -> _Split:
    """What to train on and what to test on: the newest stretch, or the end of the only one."""
    newest = history[-1]
    if len(history) == 1:
        border_s = (1.0 - HELD_OUT) * newest.seconds
        training = _Part([newest.path], max(0.0, border_s - most_s), border_s)
        return _Split(training, _Part([newest.path], border_s, math.inf))
    earlier = [each.path for each in history[:-1]][-MOST_RECORDINGS:]
    test = _Part([newest.path], max(0.0, newest.seconds - most_s), math.inf)
    return _Split(_Part(earlier, 0.0, most_s / len(earlier)), test)


def _data(part: _Part) -> TrainingData:
    return read_training_data(part.paths, None, None, part.from_s, part.to_s)


def newest(history: Sequence[Stretch], wanted_s: float) -> list[Stretch]:
    """The newest stretches that are together as long as wanted, or all."""
    chosen: list[Stretch] = []
    for each in reversed(history):
        if sum(one.seconds for one in chosen) < wanted_s:
            chosen.insert(0, each)
    return chosen


def _rate_hz(stretch: Stretch) -> tuple[float, int]:
    """Samples a second of a tray, from the first minute, and its number of fans."""
    runs = read_runs(stretch.path, to_s=60.0).runs
    seconds = sum(float(run.t_s[-1] - run.t_s[0]) for run in runs)
    return sum(len(run.t_s) for run in runs) / max(seconds, 1e-9), runs[0].command.shape[1]


def _residual(twin: Path, data: TrainingData, *, within_range: bool = False) -> tuple[Array, Array]:
    """(samples, fans) residual of the free run and measured speed, rad/s. within_range: only at commands that it was
    trained on."""
    with twin_errors():
        # The command line loads twin only when it is needed.
        from twin.build import free_run_of  # noqa: PLC0415
        from twin.export.onnx_twin import OnnxTwin  # noqa: PLC0415

        loaded = OnnxTwin(twin)
        residual, measured, command = free_run_of(loaded, data.runs)
    if within_range:
        low, high = loaded.card.command_range
        inside = (command >= low) & (command <= high)
        residual, measured = np.where(inside, residual, np.nan), np.where(inside, measured, np.nan)
    return residual, measured


def _error(twin: Path, data: TrainingData) -> float:
    """Root mean square of the free-run residual over all fans, in the unit of the recordings."""
    residual, _ = _residual(twin, data)
    return float(np.sqrt(np.nanmean(np.square(residual)))) / data.rad_s_per_unit


def _learned_s(version: Version) -> float:
    return sum(last - first for first, last in version.periods) / NS_PER_S


def _mean_change(twin: Path, data: TrainingData) -> Array:
    """(fans,) how far the mean speed is from that of a twin, as a share of it; 0 where nothing was measured."""
    residual, measured = _residual(twin, data, within_range=True)
    known = np.isfinite(residual) & np.isfinite(measured)
    expected = np.where(known, measured - residual, 0.0).sum(axis=0)
    moved = np.where(known, residual, 0.0).sum(axis=0)
    return np.divide(moved, expected, out=np.zeros(len(moved)), where=expected > 0.0)


def changed_fans(change: Array, reference: str) -> str:
    """What has changed more than healthy fans do, in words; empty if nothing has. change: (fans,), since the
    reference."""
    far = np.flatnonzero(np.abs(change) > MOST_CHANGE)
    if not len(far):
        return ""
    together = len(change) > 1 and np.all(np.sign(change) == np.sign(change[far[0]]))
    if together and np.min(np.abs(change)) > 0.5 * np.max(np.abs(change)):
        return (
            f"all fans are {_faster(float(np.mean(change)))} than when {reference} was made; if maintenance, a filter "
            "or new firmware is the reason, put this version in force"
        )
    named = ", ".join(f"fan {fan} is {_faster(float(change[fan]))}" for fan in far.tolist())
    return f"{named} than when {reference} was made; inspect it, or put this version in force if it was replaced"


def _faster(change: float) -> str:
    return f"{100.0 * abs(change):.1f} % {'faster' if change > 0.0 else 'slower'}"


def _hours(seconds: float) -> str:
    return f"{seconds / 60.0:.3g} min" if seconds < 2 * 3600.0 else f"{seconds / 3600.0:.3g} h"


@contextmanager
def _quietly() -> Iterator[None]:
    """What other commands print is not shown; their warnings are about data that nobody chose."""
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        yield
