"""How the speed of a fan is measured: one definition for configuration, twin card, model maker and simulation."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self, TypeAlias

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, TypeAdapter, model_validator

LONGEST_WINDOW_S = 60.0
REVOLUTION_S = 0.05
"""time of a revolution at 1,200 rpm: the window of an average that is the time of one, or the speed of a moment"""


class Tacho(BaseModel):
    """What a reading is of the speed.

    "instantaneous": the speed at the time of the sample. "count": pulses counted over a window, shown until the next
    count is complete, as microcontrollers and baseboard controllers of 4-pin fans do. "average": the mean speed over a
    window, however it was measured, shown until the next, as drivers and drives give it. "period": the time of the last
    revolution, shown until the next pulse.
    """

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    kind: Annotated[
        Literal["instantaneous", "count", "average", "period"],
        Field(
            description="the speed at the time of the sample, pulses over a window, the mean speed over a window, or "
            "the time of a revolution"
        ),
    ] = "instantaneous"
    pulses: Annotated[int, Field(ge=1, le=1000, description="pulses per revolution; 2 for 4-pin fans")] = 2
    window_s: Annotated[
        float,
        Field(
            ge=0,
            le=LONGEST_WINDOW_S,
            description="how long pulses are counted, or the speed is averaged; for kinds count and average only",
        ),
    ] = 0.0
    update_s: Annotated[
        float,
        Field(
            ge=0,
            le=LONGEST_WINDOW_S,
            description="time between new counts or averages; without it the window, one after another",
        ),
    ] = 0.0
    delay_s: Annotated[
        float, Field(ge=0, le=LONGEST_WINDOW_S, description="from the end of the measurement to the sample's time")
    ] = 0.0
    step_rad_s: Annotated[
        float,
        Field(ge=0, le=1e4, description="difference of two neighbouring readings; for kind average only"),
    ] = 0.0

    @model_validator(mode="after")
    def _window_fits_kind(self) -> Self:
        if self.kind == "count" and self.window_s <= 0:
            raise ValueError('a tacho of kind "count" needs window_s, the seconds over which pulses are counted')
        if self.kind == "average" and self.window_s <= 0:
            raise ValueError('a tacho of kind "average" needs window_s, the seconds over which speeds are averaged')
        if not self._has_window and (self.window_s > 0 or self.update_s > 0):
            raise ValueError(f'window_s and update_s are for a tacho of kind "count" or "average", not "{self.kind}"')
        if self.kind != "average" and self.step_rad_s > 0:
            raise ValueError(f'step_rad_s is for a tacho of kind "average", not "{self.kind}"')
        if self.kind == "count" and self.update_s > self.window_s:
            raise ValueError(f"update_s = {self.update_s:g} is longer than window_s = {self.window_s:g}")
        return self

    def __str__(self) -> str:
        delay = f", {self.delay_s:g} s late" if self.delay_s else ""
        if not self._has_window:
            return self.kind + delay
        update = f", updated every {self.update_s:g} s" if self.update_s else ""
        if self.kind == "average":
            step = f", in steps of {self.step_rad_s:.3g} rad/s" if self.step_rad_s else ""
            return f"average over {self.window_s:g} s{step}{update}{delay}"
        return f"count over {self.window_s:g} s, {self.pulses} pulses a revolution{update}{delay}"

    @property
    def as_toml(self) -> str:
        """The value of `tacho` in a configuration, without what is as by default."""
        values = self.model_dump(exclude_defaults=True) | {"kind": self.kind}
        if self.kind == "count":
            values["pulses"] = self.pulses
        names = (name for name in type(self).model_fields if name in values)
        return f"{{ {', '.join(f'{name} = {json.dumps(values[name])}' for name in names)} }}"

    @property
    def held_s(self) -> float:
        """For how long one reading is shown, s; 0 where each sample is a reading of its own."""
        return (self.update_s or self.window_s) if self._has_window else 0.0

    @property
    def resolution_rad_s(self) -> float:
        """Difference of two neighbouring readings, rad/s; 0 where it does not matter."""
        return 2 * math.pi / (self.pulses * self.window_s) if self.kind == "count" else self.step_rad_s

    @property
    def resolution_steps(self) -> float:
        """The variance of a reading of a steady speed is the square of the resolution over this: two edges of a count
        have a phase each, and rounding has one."""
        return 6.0 if self.kind == "count" else 12.0

    @property
    def _has_window(self) -> bool:
        return self.kind in ("count", "average")

    @property
    def mean_delay_s(self) -> float:
        """Mean time from a speed to the sample that shows it, s; for kind "period" without half its period."""
        return self.delay_s + (self.window_s + self.held_s) / 2

    @property
    def reach_s(self) -> float:
        """The longest time from a speed to a sample that shows it, s; for kind "period" without its period."""
        return self.delay_s + self.window_s + self.held_s


def _as_sequence(value: Any) -> Any:
    return (value,) if isinstance(value, Tacho | Mapping) else value


Tachos: TypeAlias = Annotated[
    tuple[Tacho, ...],
    Field(min_length=1),
    BeforeValidator(_as_sequence, json_schema_input_type=Tacho | tuple[Tacho, ...]),
]
"""The tachos of several fans: one that all have in common, or one for each. A single one may be written by itself."""

INSTANTANEOUS: tuple[Tacho, ...] = (Tacho(),)


def tacho_of_each_fan(tachos: Sequence[Tacho], fans: int) -> tuple[Tacho, ...]:
    """(fans,) tachos, the common one repeated. Raises ValueError where they are of another number of fans."""
    if len(tachos) not in (1, fans):
        raise ValueError(f"{len(tachos)} tachos for {fans} fans; give one for all fans, or one for each")
    return tuple(tachos) * (fans // len(tachos))


def tachos_to_json(tachos: Sequence[Tacho]) -> str:
    """One line of JSON, a list."""
    return json.dumps([tacho.model_dump(exclude_defaults=True) for tacho in tachos])


def tachos_from_json(text: str) -> tuple[Tacho, ...]:
    """The inverse of tachos_to_json. Raises ValueError where the text is not such a list."""
    return _TACHOS.validate_json(text)


_TACHOS: TypeAdapter[tuple[Tacho, ...]] = TypeAdapter(Tachos)
