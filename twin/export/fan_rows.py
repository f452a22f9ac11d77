"""Matches the fans of a twin with the fans of runs."""

from collections.abc import Sequence
from dataclasses import replace

from fantwin.schemas.twin_card import DriveCard, TwinCard
from fantwin.twin.errors import TwinError
from fantwin.twin.reference import at_reference
from fantwin.twin.runs import Run


def fan_rows(card: TwinCard, fans: int, fan_numbers: Sequence[int] | None = None) -> list[int]:
    """For each fan of some runs, its index in the card's lists per fan.

    fan_numbers: of the fans chosen from the recordings; without a choice it is all of them, counted from 0. A twin of
    one fan serves every fan. Raises TwinError where fans and twin cannot be matched.
    """
    if card.fans == 1:
        return [0] * fans
    known, numbers = card.training.fans, tuple(fan_numbers or range(fans))
    if not known and fans == card.fans:
        return list(range(fans))
    if numbers == known or (fan_numbers and set(numbers) <= set(known)):
        return [known.index(number) for number in numbers]
    in_runs = ", ".join(map(str, numbers))
    if known:
        in_twin = ", ".join(map(str, known))
        raise TwinError(
            f"twin {card.name!r} has fans {in_twin}, the runs have {in_runs}; choose its fans with --fans, or retrain"
        )
    raise TwinError(
        f"twin {card.name!r} has {card.fans} fans and does not say which, the runs have {in_runs}; "
        "give recordings of as many fans, or retrain"
    )


def drive_of_fans(card: TwinCard, rows: Sequence[int]) -> DriveCard | None:
    """The drive of a twin for the fans of some runs; rows: as fan_rows gives them."""
    if card.drive is None:
        return None
    return replace(card.drive, lowest_command=tuple(card.drive.lowest_command[row] for row in rows))


def measured_as_in_card(card: TwinCard, rows: Sequence[int], runs: Sequence[Run]) -> list[Run]:
    """The runs with the tachos of a twin, which its free run has to pass before it is compared with their readings, and
    at the twin's reference conditions.

    rows: as fan_rows gives them. Raises TwinError when a run lacks a column that the twin needs.
    """
    tacho = tuple(card.tacho_of_each_fan[row] for row in rows)
    return [replace(run, tacho=tacho) for run in at_reference(runs, card.conditions)]
