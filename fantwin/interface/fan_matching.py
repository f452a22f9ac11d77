"""Fans of a table matched with those of a twin, or of another table: by their names, else by their order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fantwin.interface.columns import Fan
from fantwin.interface.tables import NAME, FanTable
from fantwin.interface.words import warn
from fantwin.pipeline.errors import FantwinError


def matched(given: FanTable, fans: Sequence[Fan], whose: str) -> FanTable:
    """The samples of a table in the order of these fans; numbers are in rising order in each table.

    whose: whom the fans belong to, for people.

    Raises:
        FantwinError: both name their fans, and not alike.

    Warns:
        FantwinWarning: one of them does not, so they are matched by their order.
    """
    named = [all(isinstance(fan, str) for fan in each) for each in (given.fans, fans)]
    if not any(named) or len(given.fans) != len(fans):
        return given
    own, others = (", ".join(map(str, each)) for each in (given.fans, fans))
    if not all(named):
        warn([f"{NAME} has the fans {own}, and {whose} has {others}: they are matched in this order, not by name"])
        return given
    if set(given.fans) != set(fans):
        raise FantwinError(f"{NAME} has the fans {own}, and {whose} has {others}: call them alike in both")
    order = [given.fans.index(fan) for fan in fans]
    samples = replace(
        given.samples,
        command=given.samples.command[:, order],
        speed_rad_s=given.samples.speed_rad_s[:, order],
        auxiliary={name: values[:, order] for name, values in given.samples.auxiliary.items()},
    )
    return replace(given, samples=samples, fans=tuple(fans))
