"""Numbers of fans in a line for people: that of a large tray stays readable."""

from __future__ import annotations

from collections.abc import Sequence

MOST_LISTED = 8
"""fans that are listed one by one"""
MOST_RUNS = 8
"""runs of neighbouring fans that are named"""


def fans_in_words(fans: Sequence[int]) -> str:
    """`0, 3, 5`; of more than a few fans runs of neighbours, `0 to 39, 57`, and of many runs the first ones.

    fans: at least one, in rising order.
    """
    if len(fans) <= MOST_LISTED:
        return ", ".join(map(str, fans))
    runs: list[list[int]] = []
    for fan in fans:
        if runs and fan == runs[-1][-1] + 1:
            runs[-1].append(fan)
        else:
            runs.append([fan])
    named = ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs[:MOST_RUNS])
    others = sum(map(len, runs[MOST_RUNS:]))
    return f"{named} and {others} more" if others else named
