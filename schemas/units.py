"""Units: the one definition of each factor between what is stored, what people are shown and what libraries take."""

from __future__ import annotations

from typing import Literal

NS_PER_S = 1_000_000_000
S_PER_DAY = 86_400.0
SpeedUnit = Literal["rad/s", "rpm"]
RAD_S_PER_UNIT: dict[str, float] = {"rad/s": 1.0, "rpm": 0.10471975511965977}


def period_in_words(seconds: float) -> str:
    """A time between samples to three digits: 2 s, 12.5 ms."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= 0.9995 * size:
            value = seconds / size
            return f"{value:.0f} {unit}" if value >= 100 else f"{value:.3g} {unit}"
    return f"{seconds * 1e6:.3g} us"


def short_number(value: float, digits: int = 3) -> str:
    """A number to some digits, and large ones whole: 0.25, 25.1, 2520."""
    return f"{value:.0f}" if abs(value) >= 10 ** (digits - 1) else f"{value:.{digits}g}"
