"""Times in a scorer's snapshot, moved together: as after the host clock was set back while the site was stopped."""

from __future__ import annotations

from typing import Any

NEVER_NS = 1 << 62  # times from here on, and those up to 0, are marks and no times


def with_times_moved(state: Any, by_ns: int, *, is_time: bool = False) -> Any:
    """A snapshot's state, as JSON values, with all absolute times moved by `by_ns`.

    Durations, values and arrays stay.
    """
    if isinstance(state, dict):
        return {
            name: with_times_moved(entry, by_ns, is_time=is_time or name.endswith("t_ns"))
            if name != "arrays"
            else entry
            for name, entry in state.items()
        }
    if isinstance(state, list):
        return [with_times_moved(entry, by_ns, is_time=is_time) for entry in state]
    if is_time and isinstance(state, int) and 0 < state < NEVER_NS:
        return max(1, state + by_ns)
    return state
