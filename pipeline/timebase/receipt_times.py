"""Times of receipt as they would be if each sample had been sent at once.

A program may send several samples together, or after a pause all that it has kept meanwhile. The newest one that it had
then is the one that was not kept; each of the others would have come so much earlier as it is older. What follows from
times of receipt (pipeline/timebase/device_clock.py) needs them in order: they never go back.
"""

from __future__ import annotations

from collections.abc import Iterable


class ReceiptTimes:
    """The times of one source's samples, host time in ns."""

    def __init__(self) -> None:
        self._newest_t_ns = 0

    def of(self, received_t_ns: int, ages_ns: Iterable[int]) -> list[int]:
        """The times of samples that came together at `received_t_ns`, in their order.

        ages_ns: how much older each is than the newest that the sender had.
        """
        times: list[int] = []
        for age_ns in ages_ns:
            self._newest_t_ns = max(self._newest_t_ns, received_t_ns - age_ns)
            times.append(self._newest_t_ns)
        return times
