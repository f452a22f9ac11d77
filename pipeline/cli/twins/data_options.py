"""Options of the commands that train and evaluate twins, and what they report of their recordings."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.files import make_folder
from fantwin.pipeline.recordings.remote import matching, recording_path
from fantwin.schemas.reference_conditions import HOLD_S

recordings_option = partial(typer.Option, parser=recording_path, callback=matching)
recordings_argument = partial(typer.Argument, parser=recording_path, callback=matching)
RecordingsArgument: TypeAlias = Annotated[
    list[Path],
    recordings_argument(
        metavar="REC.mcap...",
        help="Recordings, also at URLs; each counts its seconds from its own start.",
    ),
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
IgnoreOption: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--ignore",
        metavar="COLUMN",
        help=f"Leave out a column that is bad: {' or '.join(HOLD_S)}. Repeatable.",
    ),
]
ValidateOption: TypeAlias = Annotated[
    list[Path] | None,
    recordings_option(
        metavar="REC.mcap...",
        help="Held-out healthy recordings: evaluated, not fitted. Of one that is also trained on, what --to, or else "
        "--from, leaves out.",
    ),
]
TestOption: TypeAlias = Annotated[
    list[Path] | None,
    recordings_option(
        metavar="REC.mcap...",
        help="Several models: healthy recordings that decide which is the best, and take no part in training.",
    ),
]
FansOption: TypeAlias = Annotated[str | None, typer.Option(help="Only these fans, counted from 0, e.g. 0,2-5.")]

TACHO_ADVICE = "see `tacho` in [[tray]], or import the table again with --tacho"
TACHO_CONSEQUENCE = (
    "hint: if so, the delay of the tacho is taken for inertia, and what follows, warnings too, may come from that"
)


def report_damage(damage: Sequence[str]) -> None:
    """Say on stderr what could not be read."""
    for line in damage:
        typer.echo(line, err=True)


def ignored_columns(names: Sequence[str] | None) -> tuple[str, ...]:
    """The names of the columns to leave out, as given.

    Raises:
        UsageError: there is no such column, or no twin uses it.
    """
    for name in names or ():
        if name not in HOLD_S:
            raise UsageError(f"--ignore {name}: known are {', '.join(HOLD_S)}, the columns that a twin can use")
    return tuple(names or ())


def show_hints(hints: Sequence[str]) -> None:
    """Say on stderr, before the work, what the declared tachos may spoil."""
    for hint in hints:
        typer.secho(f"hint: {hint}; {TACHO_ADVICE}", fg=typer.colors.YELLOW, err=True)
    if hints:
        typer.secho(TACHO_CONSEQUENCE, fg=typer.colors.YELLOW, err=True)


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
