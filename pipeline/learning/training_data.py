"""Recordings as the runs that twins are trained and evaluated on, and errors of the model maker in one line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ValidationError

from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.recordings.checksum import sha256_of
from fantwin.pipeline.recordings.training_runs import RecordedRun, RecordedTray, read_runs
from fantwin.pipeline.replay.offline.healthy_runs import MapRecordings
from fantwin.pipeline.sources.tables.units import RAD_S_PER_TABLE_UNIT
from fantwin.pipeline.sources.tacho_evidence import tacho_hints
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.tacho import Tacho

if TYPE_CHECKING:
    from fantwin.schemas.twin_card import DataCard
    from fantwin.twin.runs import Run

MANY_OUTLIERS = 0.001
_NUMBER = r"\d[\d.]*(?:e[+-]\d+)?"


@dataclass(frozen=True, eq=False)
class Source:
    """Where a run is from. first_s, last_s: its times, in seconds since the first sample of the recording."""

    path: Path
    samples: int
    first_s: float
    last_s: float


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Runs without their outliers, with the numbers and names of the fans, and the speed unit, of their recordings.

    sources: of each run. fans: the fan number of each column. outliers: a warning for each fan and file with many
    outliers. hints: what speaks against the declared tachos in the longest run; see pipeline.sources.tacho_evidence.
    damage: what could not be read, a line for each file. sha256: of files that were read whole.
    """

    runs: list[Run]
    sources: list[Source]
    speed_unit: str
    fans: list[int]
    outliers: tuple[str, ...]
    hints: tuple[str, ...] = ()
    damage: tuple[str, ...] = ()
    sha256: Mapping[Path, str] = field(default_factory=dict)
    names: FanNames = NO_NAMES

    @property
    def rad_s_per_unit(self) -> float:
        """How many rad/s one unit of the recordings is."""
        return RAD_S_PER_TABLE_UNIT[self.speed_unit]

    @property
    def labels(self) -> list[str]:
        """What people call the fan of each column."""
        return [self.names.label(fan) for fan in self.fans]

    def numbers_where(self, flags: Sequence[bool]) -> list[int]:
        """The fan numbers of the columns for which a flag is set."""
        return [number for number, flag in zip(self.fans, flags, strict=True) if flag]

    def with_fan_numbers(self, warnings: Sequence[str]) -> list[str]:
        """The outlier warnings, then those of the model maker, with the fans and the speed unit of the recordings.

        Fans share a line where it is the same. The w of an equation remains in rad/s, as its parameters are.
        """
        columns: dict[str, list[int]] = {}
        for line in warnings:
            of_fans = re.match(r"fans? ([\d, ]+)(?=:)", line)
            text = self._in_unit(line[of_fans.end() :] if of_fans else line)
            columns.setdefault(text, []).extend(map(int, of_fans[1].split(",")) if of_fans else ())
        labels = {
            text: self.names.labels([self.fans[each] for each in sorted(set(of))]) if of else ""
            for text, of in columns.items()
        }
        return [*self.outliers, *(f"{labels[text]}{text}" for text in columns)]

    def _in_unit(self, line: str) -> str:
        if self.speed_unit == "rad/s":
            return line

        def converted(found: re.Match[str]) -> str:
            in_unit = re.sub(_NUMBER, lambda number: _rounded(float(number[0]) / self.rad_s_per_unit), found[1])
            return f"{in_unit} {self.speed_unit}"

        return re.sub(rf"(?<!w = )({_NUMBER}(?: and {_NUMBER})?) rad/s", converted, line)


def _rounded(value: float) -> str:
    return f"{float(f'{value:.3g}'):g}"


@dataclass(frozen=True)
class Part:
    """The part of each recording that is read. windows_s: of tachos, in place of the recordings' own. ignored: columns
    that a twin could use, but that are left out."""

    tray: str | None = None
    fans: Sequence[int] | None = None
    from_s: float = 0.0
    to_s: float = math.inf
    windows_s: tuple[float, ...] = ()
    ignored: tuple[str, ...] = ()


def read_training_data(recordings: Sequence[Path], part: Part, each: MapRecordings) -> TrainingData:
    """The runs of several recordings, their outliers left out. each: does the work on each recording.

    All samples of the part are in memory, 16 bytes a sample and fan: a fit needs them all.

    Raises:
        UserError: a recording cannot be used, or they are not in one unit.
    """
    return joined(list(each(partial(read_recording_data, part=part), recordings, "reading")))


def read_recording_data(path: Path, part: Part) -> TrainingData:
    """The runs of one recording. Raises as `read_training_data`."""
    found = read_runs(path, part.tray, part.fans, part.from_s, part.to_s)
    found = replace(found, runs=tuple(_without(run, part.ignored) for run in found.runs))
    data = training_data_of(found, part.fans, part.windows_s)
    longest, tacho = max(
        ((run, run_data.tacho) for run, run_data in zip(found.runs, data.runs, strict=True)),
        key=lambda each: len(each[0].t_s),
    )
    hints = tacho_hints(longest.t_s, longest.speed_rad_s, tacho, data.fans, data.names)
    return replace(data, hints=tuple(hints), sha256={path: sha256_of(path)})


def _without(run: RecordedRun, ignored: Sequence[str]) -> RecordedRun:
    return replace(run, auxiliary={name: of for name, of in run.auxiliary.items() if name not in ignored})


def training_data_of(
    found: RecordedTray, fans: Sequence[int] | None = None, windows_s: Sequence[float] = ()
) -> TrainingData:
    """The runs of what was read of a recording, their outliers left out. fans, windows_s: as of `Part`.

    Raises:
        UserError: their speed unit is not known.
    """
    from fantwin.twin.fitting.outliers import without_outliers  # noqa: PLC0415
    from fantwin.twin.runs import Run  # noqa: PLC0415

    path = found.runs[0].path
    tacho = counting_tachos(windows_s) if windows_s else found.tacho
    numbers = list(fans or range(found.runs[0].command.shape[1]))
    with twin_errors():
        cleaned = [
            without_outliers(Run(path.stem, run.t_s, run.command, run.speed_rad_s, tacho, run.auxiliary))
            for run in found.runs
        ]
    return TrainingData(
        runs=[run for run, _ in cleaned],
        sources=[Source(path, len(run.t_s), float(run.t_s[0]), float(run.t_s[-1])) for run in found.runs],
        speed_unit=common_unit([(found.speed_unit, path)]),
        fans=numbers,
        outliers=tuple(
            f"{path}: {found.names.label(fan)}: {share:.1%} of the speeds are outliers and left out; check the tacho "
            "and its wiring"
            for _, shares in cleaned
            for fan, share in zip(numbers, shares, strict=False)
            if share > MANY_OUTLIERS
        ),
        damage=(found.damage,) if found.damage else (),
        names=found.names,
    )


def joined(parts: Sequence[TrainingData]) -> TrainingData:
    """Training data of several recordings, or parts of them, together.

    Raises:
        UserError: they are not in one unit, or of one number of fans.
    """
    require_same_fans(parts)
    longest = max(parts, key=lambda part: max(source.samples for source in part.sources))
    return TrainingData(
        runs=[run for part in parts for run in part.runs],
        sources=[source for part in parts for source in part.sources],
        speed_unit=common_unit([(part.speed_unit, part.sources[0].path) for part in parts]),
        fans=parts[0].fans,
        outliers=tuple(dict.fromkeys(line for part in parts for line in part.outliers)),
        hints=longest.hints,
        damage=tuple(line for part in parts for line in part.damage),
        sha256={path: digest for part in parts for path, digest in part.sha256.items()},
        names=parts[0].names,
    )


def require_same_fans(parts: Sequence[TrainingData]) -> None:
    """Raise UserError for recordings of different numbers of fans."""
    files: dict[int, Path] = {}
    for part in parts:
        files.setdefault(len(part.fans), part.sources[0].path)
    if len(files) > 1:
        found = " and ".join(f"{fans} ({path})" for fans, path in files.items())
        raise UserError(
            f"recordings of different numbers of fans, {found}: give those of one tray, or choose with --fans"
        )


def common_unit(found: Sequence[tuple[str, Path]]) -> str:
    """The speed unit of several recordings.

    Raises:
        UserError: they have different units, or one that is not known.
    """
    units: dict[str, Path] = {}
    for unit, path in found:
        units.setdefault(unit, path)
    if len(units) > 1:
        found_units = " and ".join(f"{unit} ({path})" for unit, path in units.items())
        raise UserError(f"recordings in different units, {found_units}: give recordings of one unit")
    ((unit, path),) = units.items()
    if unit not in RAD_S_PER_TABLE_UNIT:
        raise UserError(f"{path}: unknown speed unit {unit!r}; known: {', '.join(RAD_S_PER_TABLE_UNIT)}")
    return unit


def counting_tachos(windows_s: Sequence[float]) -> tuple[Tacho, ...]:
    """Tachos that count the usual two pulses a revolution over these windows.

    Raises:
        UsageError: a window is not possible.
    """
    try:
        return tuple(Tacho(kind="count", window_s=window_s) for window_s in windows_s)
    except ValidationError as error:
        raise UsageError(f"--window: {error.errors()[0]['msg'].removeprefix('Value error, ')}") from error


@contextmanager
def twin_errors(data: TrainingData | None = None) -> Iterator[None]:
    """Turns errors of the twin package into a UserError of one line. data: whose fans its columns are."""
    from fantwin.twin.errors import TwinError  # noqa: PLC0415

    try:
        yield
    except TwinError as error:
        line = str(error)
        raise UserError(data.with_fan_numbers([line])[-1] if data else line) from error


def data_cards(data: TrainingData) -> list[DataCard]:
    """One card entry for each file of the training data."""
    from fantwin.schemas.twin_card import DataCard  # noqa: PLC0415

    runs: dict[Path, list[Source]] = {}
    for source in data.sources:
        runs.setdefault(source.path, []).append(source)
    return [
        DataCard(
            name=path.name,
            sha256=data.sha256.get(path) or sha256_of(path),
            fans=len(data.fans),
            samples=sum(source.samples for source in sources),
            first_s=min(source.first_s for source in sources),
            last_s=max(source.last_s for source in sources),
        )
        for path, sources in runs.items()
    ]


def read_held_out(
    training_data: TrainingData, recordings: Sequence[Path], part: Part, each: MapRecordings
) -> TrainingData:
    """Recordings for evaluation, which take no part in the fit; of one that is fitted in part, the rest.

    part: of the training data.

    Raises:
        UserError: they cannot be used, are in another unit or of other fans, or overlap the training data.
    """
    trained_on = frozenset(source.path for source in training_data.sources)
    read = partial(_read_held_out, part=part, trained_on=trained_on)
    held_out = joined(list(each(read, recordings, "reading")))
    if held_out.speed_unit != training_data.speed_unit:
        raise UserError(
            f"{recordings[0]}: speeds in {held_out.speed_unit}, the training data are in {training_data.speed_unit}: "
            "give recordings of one unit"
        )
    require_same_fans([training_data, held_out])
    for own in held_out.sources:
        for other in training_data.sources:
            if own.path == other.path and own.first_s <= other.last_s and other.first_s <= own.last_s:
                raise UserError(
                    f"{own.path}: overlaps the training data; give another recording, or train on a part with --to"
                )
    return held_out


def _read_held_out(path: Path, part: Part, trained_on: frozenset[Path]) -> TrainingData:
    whole = replace(part, from_s=0.0, to_s=math.inf)
    if path not in trained_on:
        return read_recording_data(path, whole)
    rest = replace(whole, from_s=part.to_s) if part.to_s < math.inf else replace(whole, to_s=part.from_s or math.inf)
    return read_recording_data(path, rest)
