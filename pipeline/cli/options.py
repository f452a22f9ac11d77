"""Options that several commands share, and what they mean."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from fantwin.pipeline.errors import UsageError
from fantwin.schemas.fan_names import NO_NAMES, FanNames

ConfigOption: TypeAlias = Annotated[Path, typer.Option("-c", "--config", help="Configuration file (TOML).")]
SetOption: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override one key, e.g. scorer.alarm_share=1.0. Repeatable."),
]
JsonOption: TypeAlias = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]

LowOption: TypeAlias = Annotated[
    float | None,
    typer.Option(help="With --sweep: lowest command; default a fifth of the tray's range, where most fans turn."),
]
HighOption: TypeAlias = Annotated[
    float | None, typer.Option(help="With --sweep: highest command; default command_max of the tray.")
]
SafeOption: TypeAlias = Annotated[
    float | None,
    typer.Option(help="With --sweep: the command at the end and after Ctrl-C; default what each fan had before."),
]
RoundsOption: TypeAlias = Annotated[
    int, typer.Option(min=1, max=100, help="With --sweep: how often all levels are passed.")
]

DEFAULT_CONFIG = Path("fantwin.toml")


class ViewLayout(StrEnum):
    """The layouts of a view, which `pipeline.outputs.rerun.rerun_layout` draws; that needs the extra `view`."""

    ALL = "all"
    ALARMS = "alarms"
    WEAR = "wear"


def fan_numbers(text: str | None, names: Callable[[], FanNames]) -> list[int] | None:
    """The fans of an option such as `--fans 2,5`, `0-3` or `CPU`. names: asked for where one is no number.

    Raises:
        UsageError: it is not an ascending list of fans.
    """
    if text is None:
        return None
    parts = [number for part in text.split(",") for number in _run_of_fans(part)]
    try:
        known = NO_NAMES if all(part.strip().removeprefix("-").isdecimal() for part in parts) else names()
        numbers = [known.number(part) for part in parts]
    except ValueError as error:
        raise UsageError(f"--fans {text}: {error}") from error
    if numbers != sorted(set(numbers)):
        raise UsageError(f"--fans {text}: give each fan once, in ascending order")
    return numbers


def _run_of_fans(part: str) -> list[str]:
    """`0-3` as its numbers; anything else as it is."""
    run = re.fullmatch(r"\s*(\d{1,4})\s*-\s*(\d{1,4})\s*", part)
    return [str(fan) for fan in range(int(run[1]), int(run[2]) + 1)] or [part] if run else [part]


def recorded_names(recordings: Sequence[Path], tray: str | None) -> Callable[[], FanNames]:
    """For `fan_numbers`, the names in the first recording."""

    def names() -> FanNames:
        from fantwin.pipeline.recordings.reading import read_metadata  # noqa: PLC0415  slow to import

        return read_metadata(recordings[0]).names(tray)

    return names
