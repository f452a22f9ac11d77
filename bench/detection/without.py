"""The decision without a part of the model: what would be lost, if it were deleted.

While `without` is entered, calibration and judging both do without it, so that what is learned fits what is left.
Product code has no switches for this: names of modules and attributes of classes are replaced in this process, and so
in the processes that are forked from it. `fantwin` in a process of its own is not changed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Any
from unittest.mock import patch

from bench.detection.mechanisms import MECHANISMS, Mechanism

NOTHING = "nothing"
"""the name of the decision as it is, in tables"""
LIST = "list"
"""in place of a name: print all"""


class UnknownMechanismError(Exception):
    """There is no mechanism of this name."""


@contextmanager
def without(*names: str) -> Iterator[None]:
    """Leave some mechanisms out, in this process; `NOTHING` leaves out none.

    Raises:
        UnknownMechanismError: there is none of this name.
    """
    with ExitStack() as replaced:
        for name in names:
            for place, change in mechanism(name).replaced if name != NOTHING else ():
                owner, attribute = owner_of(place)
                replaced.enter_context(patch.object(owner, attribute, change(vars(owner)[attribute])))
        yield


def mechanism(name: str) -> Mechanism:
    """The mechanism of a name.

    Raises:
        UnknownMechanismError: there is none.
    """
    for one in MECHANISMS:
        if one.name == name:
            return one
    raise UnknownMechanismError(f"--without {name!r}: there is no such mechanism; --without list prints their names")


def owner_of(place: str) -> tuple[Any, str]:
    """The module or class that has the name of a place, and the name."""
    module, _, path = place.partition(":")
    *classes, attribute = path.split(".")
    owner: Any = import_module(module)
    for each in classes:
        owner = vars(owner)[each]
    return owner, attribute


def list_mechanisms() -> None:
    """Print the names of all, with a line on each."""
    width = max(len(one.name) for one in MECHANISMS)
    for one in MECHANISMS:
        print(f"{one.name:{width}}  {one.what}")
