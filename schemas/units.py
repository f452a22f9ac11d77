"""Units: the one definition of each factor between what is stored, what people are shown and what libraries take."""

from __future__ import annotations

from typing import Literal

NS_PER_S = 1_000_000_000
S_PER_DAY = 86_400.0
SpeedUnit = Literal["rad/s", "rpm"]
RAD_S_PER_UNIT: dict[str, float] = {"rad/s": 1.0, "rpm": 0.10471975511965977}
