"""The one exception of the simulation, and what it says of a word that is not known."""

import difflib
from collections.abc import Iterable


class SimulationError(ValueError):
    """A setting of the simulation cannot be used. One line: what is wrong and what to do about it."""


def nearest(word: str, known: Iterable[str]) -> str:
    """What may have been meant by a word that is not known."""
    known = list(known)
    close = difflib.get_close_matches(word, known, n=1)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
