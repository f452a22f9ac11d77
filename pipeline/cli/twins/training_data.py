"""What the commands that build and judge twins share: recordings as runs, errors in one line."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from pipeline.cli.options import fan_numbers
from pipeline.devices.measured_table import RAD_S_PER_TABLE_UNIT
from pipeline.errors import UserError
from pipeline.optional_dependencies import how_to_install
from pipeline.recordings.runs import RecordedRun, read_runs

if TYPE_CHECKING:
    from schemas.twin_card import DataCard
    from twin.runs import Run

RecordingsArgument: TypeAlias = Annotated[
    list[Path], typer.Argument(metavar="REC.mcap...", help="Recordings; each counts its seconds from its own start.")
]
FromOption: TypeAlias = Annotated[float, typer.Option("--from", help="Use each recording from this second on.")]
ToOption: TypeAlias = Annotated[float, typer.Option("--to", help="Use each recording up to this second.")]
TrayOption: TypeAlias = Annotated[str | None, typer.Option(help="Which tray, where a recording has several.")]
FansOption: TypeAlias = Annotated[str | None, typer.Option(help="Only these fans, counted from 0, e.g. 0,2.")]

MANY_OUTLIERS = 0.001
_EXTRA_MODULES = ("jinja2", "matplotlib", "onnx", "scipy", "torch")


@dataclass(frozen=True, eq=False)
class Material:
    """Runs for the model maker, outliers left out, and what people call their fans and units.

    fans: the numbers of the runs' columns in the tray. outliers: one line for each fan and file that had some.
    """

    runs: list[Run]
    recorded: list[RecordedRun]
    speed_unit: str
    fans: list[int]
    outliers: tuple[str, ...]

    @property
    def rad_s_per_unit(self) -> float:
        """One of the people's unit in rad/s."""
        return RAD_S_PER_TABLE_UNIT[self.speed_unit]

    def named(self, warnings: Sequence[str]) -> list[str]:
        """Warnings of the model maker, which counts columns, with the fans' own numbers; those of outliers first."""
        return [
            *self.outliers,
            *(re.sub(r"^fan (\d+):", lambda found: f"fan {self.fans[int(found[1])]}:", line) for line in warnings),
        ]


def read_material(
    recordings: Sequence[Path], tray: str | None, fans: str | None, from_s: float, to_s: float
) -> Material:
    """The runs of several recordings, their outliers left out. What is damaged in them is told on stderr.

    Raises:
        UserError: a recording cannot be used, or they are not in one unit.
    """
    from twin.fitting.outliers import without_outliers  # noqa: PLC0415  the command line loads twin only when it is needed
    from twin.runs import Run  # noqa: PLC0415

    recorded: list[RecordedRun] = []
    units: dict[str, Path] = {}
    for path in recordings:
        found = read_runs(path, tray, fan_numbers(fans), from_s, to_s)
        if found.damage:
            typer.echo(found.damage, err=True)
        recorded += found.runs
        units.setdefault(found.speed_unit, path)
    if len(units) > 1:
        said = " and ".join(f"{unit} ({path})" for unit, path in units.items())
        raise UserError(f"recordings in different units, {said}: give those of one unit")
    (unit,) = units
    if unit not in RAD_S_PER_TABLE_UNIT:
        raise UserError(f"{units[unit]}: unknown unit of speed {unit!r}; known: {', '.join(RAD_S_PER_TABLE_UNIT)}")
    with model_maker():
        cleaned = [without_outliers(Run(run.path.stem, run.t_s, run.command, run.speed_rad_s)) for run in recorded]
    numbers = fan_numbers(fans) or list(range(recorded[0].command.shape[1]))
    outliers = tuple(
        f"{run.path}: fan {fan}: {share:.1%} of the speeds are outliers and left out; check the tacho and its line"
        for run, (_, shares) in zip(recorded, cleaned, strict=True)
        for fan, share in zip(numbers, shares, strict=False)
        if share > MANY_OUTLIERS
    )
    return Material([run for run, _ in cleaned], recorded, unit, numbers, outliers)


@contextmanager
def model_maker() -> Iterator[None]:
    """Around calls of the model maker: its errors, and a missing extra, become one line."""
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


def data_cards(material: Material) -> list[DataCard]:
    """The files of some material, for a card: one entry a file."""
    from schemas.twin_card import DataCard  # noqa: PLC0415

    samples: dict[Path, int] = {}
    for run in material.recorded:
        samples[run.path] = samples.get(run.path, 0) + len(run.t_s)
    fans = material.runs[0].fans
    return [
        DataCard(name=path.name, sha256=sha256_of(path), fans=fans, samples=count) for path, count in samples.items()
    ]


def sha256_of(path: Path) -> str:
    """Of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_held_out(
    material: Material, recordings: Sequence[Path], tray: str | None, fans: str | None, from_s: float, to_s: float
) -> Material:
    """Recordings to judge by and not to learn from.

    Raises:
        UserError: they cannot be used, are in another unit, or hold what was learned from.
    """
    held_out = read_material(recordings, tray, fans, from_s, to_s)
    if held_out.speed_unit != material.speed_unit:
        raise UserError(
            f"{recordings[0]}: speeds in {held_out.speed_unit}, those to learn from in {material.speed_unit}: "
            "give recordings of one unit"
        )
    for own in held_out.recorded:
        for other in material.recorded:
            if own.path == other.path and own.t_s[0] <= other.t_s[-1] and other.t_s[0] <= own.t_s[-1]:
                raise UserError(
                    f"{own.path}: judged by what it was learned from; give another recording, or other seconds of it"
                )
    return held_out


def check_writable(output: Path, suffix: str) -> None:
    """Before long work: that its result can be written, and that nothing else is overwritten by mistake.

    Raises:
        UserError: it cannot, or the name does not end as it should.
    """
    if output.suffix != suffix:
        raise UserError(f"{output}: name a file that ends in {suffix} with -o")
    made_folder(output.parent)
    existed = output.exists()
    try:
        output.open("ab").close()
        if not existed:
            output.unlink()
    except OSError as error:
        raise UserError(f"{output}: cannot be written: {error.strerror}; name another file with -o") from error


def made_folder(folder: Path) -> Path:
    """The folder, made where it was missing.

    Raises:
        UserError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made: {error.strerror}; name another folder with -o") from error
    return folder
