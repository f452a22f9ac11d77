"""Options that several commands share, and what they mean."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from fantwin.pipeline.errors import UsageError

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


def fan_numbers(text: str | None) -> list[int] | None:
    """The fans of an option such as `--fans 2,5`.

    Raises:
        UsageError: it is not an ascending list of fan numbers.
    """
    if text is None:
        return None
    try:
        numbers = [int(part) for part in text.split(",")]
        if numbers != sorted(set(numbers)):
            raise UsageError(f"--fans {text}: give each fan once, in ascending order")
        return numbers
    except ValueError as error:
        raise UsageError(f"--fans {text}: give fan numbers counted from 0, with commas: --fans 2,5") from error
