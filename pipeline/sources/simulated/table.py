"""A measured table played back as a device: each row at its own time, gaps included."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.tables.measured_table import Table
from fantwin.schemas.device_sample import DeviceSample
from fantwin.schemas.units import NS_PER_S


class TableDevice:
    """A `Device` (pipeline.sources.simulated.device) that gives the rows of a table and ignores commands.

    The clock of a sample is the table's time, its sequence counts rows.
    """

    def __init__(self, table: Table, from_s: float, to_s: float) -> None:
        """Rows with from_s <= t < to_s, t in seconds since the first row of the table.

        Raises:
            UserError: there is no such row.
        """
        since_first_s = (table.t_ns - table.t_ns[0]) / NS_PER_S
        rows = (since_first_s >= from_s) & (since_first_s < to_s)
        if not rows.any():
            raise UserError(
                f"{table.path}: no row from {from_s:g} s to {to_s:g} s; the table is {table.duration_s:g} s long; "
                "see from_s and to_s"
            )
        t_ns = table.t_ns[rows]
        self._t_s = (t_ns - t_ns[0]) / NS_PER_S
        self._clock_us = (t_ns - t_ns[0]) // 1000 % 2**32
        self._command = table.command[rows]
        self._speed_rad_s = table.speed_rad_s[rows]
        self._auxiliary = {name: values[rows] for name, values in table.auxiliary.items()}
        self._next = 0
        self.fans = table.fans

    def due_s(self) -> float | None:
        """Time of the next row, s since the first; None after the last."""
        return float(self._t_s[self._next]) if self._next < len(self._t_s) else None

    def take(self) -> DeviceSample:
        """The next row."""
        row = self._next
        self._next += 1
        return DeviceSample(
            float(self._t_s[row]),
            int(self._clock_us[row]),
            row,
            self._command[row],
            self._speed_rad_s[row],
            {name: values[row] for name, values in self._auxiliary.items()},
        )

    def command(self, values: NDArray[np.float64]) -> None:
        """Ignored: a measured table does not react."""

    def set_point(self, values_rad_s: NDArray[np.float64]) -> None:
        """Ignored: a measured table does not react."""
