"""How long computations report how far they are."""

from collections.abc import Callable

Progress = Callable[[str, int, int, float], None]
"""Called with the part of the work, its iterations done and at most (0: not counted), and the present free-run rmse in
rad/s (NaN: none yet)."""


def unreported(part: str, done: int, at_most: int, rmse_rad_s: float) -> None:
    """For work whose progress nobody wants to know."""


def within(whole: str, progress: Progress) -> Progress:
    """The same for work that is itself a part, whose name goes before those of its own parts."""
    return lambda part, done, at_most, rmse_rad_s: progress(f"{whole}: {part}", done, at_most, rmse_rad_s)
