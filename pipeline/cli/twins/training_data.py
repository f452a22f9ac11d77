"""Shared by the commands that train and evaluate twins: recordings as runs, and errors in one line."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer
from pydantic import ValidationError

from pipeline.cli.options import fan_numbers
from pipeline.devices.measured_table import RAD_S_PER_TABLE_UNIT
from pipeline.devices.tacho_evidence import tacho_hints
from pipeline.errors import UsageError, UserError
from pipeline.optional_dependencies import how_to_install
from pipeline.recordings.runs import RecordedRun, RecordedTray, read_runs
from schemas.tacho import Tacho

if TYPE_CHECKING:
    from schemas.twin_card import DataCard
    from twin.runs import Run

RecordingsArgument: TypeAlias = Annotated[
    list[Path], typer.Argument(metavar="REC.mcap...", help="Recordings; each counts its seconds from its own start.")
]
FromOption: TypeAlias = Annotated[
    float, typer.Option("--from", min=0.0, help="Use each recording from this second on.")
]
ToOption: TypeAlias = Annotated[float, typer.Option("--to", min=0.0, help="Use each recording up to this second.")]
TrayOption: TypeAlias = Annotated[str | None, typer.Option(help="Which tray, where a recording has several.")]
WindowOption: TypeAlias = Annotated[
    list[float] | None,
    typer.Option(
        "--window",
        metavar="S",
        help="Seconds over which tachos count two pulses a revolution, in place of what the recordings say: one for "
        "all fans, or one for each. Repeatable.",
    ),
]
FansOption: TypeAlias = Annotated[str | None, typer.Option(help="Only these fans, counted from 0, e.g. 0,2.")]

TACHO_ADVICE = "see `tacho` in [[tray]], or --window for recordings that do not say"
TACHO_CONSEQUENCE = (
    "hint: if so, the delay of the tacho is taken for inertia, and what follows, warnings too, may come from that"
)
MANY_OUTLIERS = 0.001
_NUMBER = r"\d[\d.]*(?:e[+-]\d+)?"
_EXTRA_MODULES = ("jinja2", "matplotlib", "onnx", "scipy", "torch")


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Runs without their outliers, with the fan numbers and the speed unit of their recordings.

    fans: the fan number of each column. outliers: a warning for each fan and file with many outliers.
    """

    runs: list[Run]
    recorded: list[RecordedRun]
    speed_unit: str
    fans: list[int]
    outliers: tuple[str, ...]

    @property
    def rad_s_per_unit(self) -> float:
        """How many rad/s one unit of the recordings is."""
        return RAD_S_PER_TABLE_UNIT[self.speed_unit]

    def with_fan_numbers(self, warnings: Sequence[str]) -> list[str]:
        """The outlier warnings, then those of the model maker with its column numbers replaced by fan numbers, and with
        its speeds in the unit of the recordings, too."""
        numbered = [re.sub(r"^fan (\d+):", lambda found: f"fan {self.fans[int(found[1])]}:", line) for line in warnings]
        return [*self.outliers, *map(self._with_unit, numbered)]

    def _with_unit(self, line: str) -> str:
        if self.speed_unit == "rad/s":
            return line

        def in_both(found: re.Match[str]) -> str:
            in_unit = re.sub(_NUMBER, lambda number: _rounded(float(number[0]) / self.rad_s_per_unit), found[1])
            return f"{found[0]} ({in_unit} {self.speed_unit})"

        return re.sub(rf"({_NUMBER}(?: and {_NUMBER})?) rad/s", in_both, line)

    def tacho_hints(self) -> list[str]:
        """What speaks against the declared tachos in the longest run; see pipeline.devices.tacho_evidence."""
        longest = max(self.recorded, key=lambda run: len(run.t_s))
        return tacho_hints(longest.t_s, longest.speed_rad_s, self.runs[0].tacho, self.fans)


def _rounded(value: float) -> str:
    return f"{float(f'{value:.3g}'):g}"


def read_training_data(
    recordings: Sequence[Path],
    tray: str | None,
    fans: str | None,
    from_s: float,
    to_s: float,
    windows_s: Sequence[float] | None = None,
) -> TrainingData:
    """The runs of several recordings, their outliers left out. Damage in a recording is reported on stderr.

    windows_s: of tachos that count, in place of the recordings' own; see WindowOption.

    Raises:
        UserError: a recording cannot be used, or they are not in one unit.
    """
    found = [read_runs(path, tray, fan_numbers(fans), from_s, to_s) for path in recordings]
    for each in found:
        if each.damage:
            typer.echo(each.damage, err=True)
    return training_data_of(found, fans, windows_s)


def training_data_of(
    found: Sequence[RecordedTray], fans: str | None = None, windows_s: Sequence[float] | None = None
) -> TrainingData:
    """The runs of what was read of recordings, their outliers left out. fans, windows_s: as for `read_training_data`.

    Raises:
        UserError: they are not in one unit.
    """
    from twin.fitting.outliers import without_outliers  # noqa: PLC0415  the command line loads twin only when it is needed
    from twin.runs import Run  # noqa: PLC0415

    counted = counting_tachos(windows_s) if windows_s else None
    recorded = [run for each in found for run in each.runs]
    tachos = [counted or each.tacho for each in found for _ in each.runs]
    unit = common_unit([(each.speed_unit, each.runs[0].path) for each in found])
    with twin_errors():
        cleaned = [
            without_outliers(Run(run.path.stem, run.t_s, run.command, run.speed_rad_s, tacho))
            for run, tacho in zip(recorded, tachos, strict=True)
        ]
    numbers = fan_numbers(fans) or list(range(recorded[0].command.shape[1]))
    outliers = tuple(
        f"{run.path}: fan {fan}: {share:.1%} of the speeds are outliers and left out; check the tacho and its wiring"
        for run, (_, shares) in zip(recorded, cleaned, strict=True)
        for fan, share in zip(numbers, shares, strict=False)
        if share > MANY_OUTLIERS
    )
    return TrainingData([run for run, _ in cleaned], recorded, unit, numbers, outliers)


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


def show_hints(hints: Sequence[str]) -> None:
    """Say on stderr, before the work, what the declared tachos may spoil."""
    for hint in hints:
        typer.secho(f"hint: {hint}; {TACHO_ADVICE}", fg=typer.colors.YELLOW, err=True)
    if hints:
        typer.secho(TACHO_CONSEQUENCE, fg=typer.colors.YELLOW, err=True)


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
def twin_errors() -> Iterator[None]:
    """Turns errors of the twin package, and a missing extra, into a UserError of one line."""
    try:
        from twin.errors import TwinError  # noqa: PLC0415

        try:
            yield
        except TwinError as error:
            raise UserError(str(error)) from error
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in _EXTRA_MODULES:
            raise
        raise UserError(f"this needs the extra `train` ({error.name}); {how_to_install('train')}") from error


def data_cards(training_data: TrainingData) -> list[DataCard]:
    """One card entry for each file of the training data."""
    from schemas.twin_card import DataCard  # noqa: PLC0415

    samples: dict[Path, int] = {}
    for run in training_data.recorded:
        samples[run.path] = samples.get(run.path, 0) + len(run.t_s)
    fans = training_data.runs[0].fans
    return [
        DataCard(name=path.name, sha256=sha256_of(path), fans=fans, samples=count) for path, count in samples.items()
    ]


def sha256_of(path: Path) -> str:
    """The hash of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_held_out(
    training_data: TrainingData,
    recordings: Sequence[Path],
    tray: str | None,
    fans: str | None,
    from_s: float,
    to_s: float,
    windows_s: Sequence[float] | None = None,
) -> TrainingData:
    """Recordings for evaluation, which take no part in the fit.

    Raises:
        UserError: they cannot be used, are in another unit, or overlap the training data.
    """
    held_out = read_training_data(recordings, tray, fans, from_s, to_s, windows_s)
    if held_out.speed_unit != training_data.speed_unit:
        raise UserError(
            f"{recordings[0]}: speeds in {held_out.speed_unit}, the training data are in {training_data.speed_unit}: "
            "give recordings of one unit"
        )
    for own in held_out.recorded:
        for other in training_data.recorded:
            if own.path == other.path and own.t_s[0] <= other.t_s[-1] and other.t_s[0] <= own.t_s[-1]:
                raise UserError(
                    f"{own.path}: overlaps the training data; give another recording, or other seconds of it"
                )
    return held_out


def check_writable(output: Path, suffix: str) -> None:
    """Check before long work that its result can be written, under a name with this suffix.

    Raises:
        UserError: it cannot be written, or the name has another suffix.
    """
    if output.suffix != suffix:
        raise UsageError(f"{output}: name a file that ends in {suffix} with -o")
    make_folder(output.parent)
    existed = output.exists()
    try:
        output.open("ab").close()
        if not existed:
            output.unlink()
    except OSError as error:
        raise UserError(f"{output}: cannot be written: {error.strerror}; name another file with -o") from error


def make_folder(folder: Path) -> Path:
    """Create the folder if it is missing.

    Raises:
        UserError: it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be created: {error.strerror}; name another folder with -o") from error
    return folder
