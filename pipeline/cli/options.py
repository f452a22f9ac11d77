"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from pipeline.errors import UsageError

ConfigOption: TypeAlias = Annotated[Path, typer.Option("-c", "--config", help="Configuration file (TOML).")]
SetOption: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override one key, e.g. scorer.on_delay_s=1.0. Repeatable."),
]
JsonOption: TypeAlias = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]

DEFAULT_CONFIG = Path("fantwin.toml")


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
