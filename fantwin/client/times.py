"""Times as programs have them, to nanoseconds."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fantwin.client.errors import TimeOrderError
from fantwin.schemas.messages import FURTHEST_T_NS
from fantwin.schemas.units import NS_PER_S

Time: TypeAlias = "float | int | datetime | np.datetime64"
_DAY_NS = 86_400 * NS_PER_S
_UNIX_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def times_ns(t: Time | Sequence[Time] | NDArray[Any]) -> NDArray[np.int64]:
    """(n,) times in ns: one, or as many as there are in a sequence.

    t: floats are seconds, integers are nanoseconds, both since 1970; or dates, which must have a time zone
    (`numpy.datetime64` is UTC).

    Raises:
        TimeOrderError: it is no time, or beyond the year 2116.
    """
    values = np.atleast_1d(np.asarray(t))
    if values.dtype == object and values.ndim == 1:
        return np.array([_date_ns(each) for each in values], np.int64)
    if values.dtype.kind not in "iufM" or values.ndim != 1:
        raise TimeOrderError(f"t = {t!r}: give seconds as float, nanoseconds as int, or dates")
    if values.dtype.kind == "M":
        if np.isnat(values).any():
            raise TimeOrderError("t has a date that is not a time (NaT)")
        days = values.astype("datetime64[D]").astype(np.int64)  # nanoseconds of numpy overflow silently in 2262
        if (beyond := np.abs(days) >= FURTHEST_T_NS // _DAY_NS).any():
            raise TimeOrderError(f"t = {values[beyond][0]}: beyond the year 2116")
        return values.astype("datetime64[ns]").astype(np.int64)
    ns = values.astype(np.float64) * (NS_PER_S if values.dtype.kind == "f" else 1)
    if not np.all(np.abs(ns) < FURTHEST_T_NS):  # NaN is not
        raise TimeOrderError(f"t = {values[~(np.abs(ns) < FURTHEST_T_NS)][0]}: no time, or beyond the year 2116")
    if values.dtype.kind != "f":
        return values.astype(np.int64)
    whole = np.floor(values)
    return whole.astype(np.int64) * NS_PER_S + np.rint((values - whole) * NS_PER_S).astype(np.int64)


def _date_ns(date: Any) -> int:
    if not isinstance(date, datetime) or date.tzinfo is None:
        raise TimeOrderError(f"t = {date!r}: a date without a time zone: use for example datetime.now(UTC)")
    ns = (date - _UNIX_EPOCH) // timedelta(microseconds=1) * 1000
    if abs(ns) >= FURTHEST_T_NS:
        raise TimeOrderError(f"t = {date}: beyond the year 2116")
    return ns
