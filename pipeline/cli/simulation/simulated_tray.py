"""The simulated tray that the options of `fantwin simulate` describe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from fantwin.pipeline.errors import UsageError
from fantwin.schemas.auxiliary import AUXILIARY
from fantwin.schemas.tacho import Tacho

if TYPE_CHECKING:
    from fantwin.simulation.tray import SimulatedTray

_TACHO_OPTIONS = {
    "kind": "--tacho",
    "pulses": "--pulses",
    "window_s": "--window",
    "update_s": "--update",
    "delay_s": "--tacho-delay",
}


def made_tacho(**settings: Any) -> Tacho:
    """The tacho with these settings; see `schemas.tacho.Tacho`.

    Raises:
        UsageError: they do not fit one another, or one is out of range.
    """
    try:
        return Tacho(**settings)
    except ValidationError as error:
        first = error.errors()[0]
        where = f"{_TACHO_OPTIONS[str(first['loc'][0])]} {first['input']}: " if first["loc"] else ""
        text = first["msg"].removeprefix("Value error, ")
        for field in ("window_s", "update_s"):
            text = text.replace(field, _TACHO_OPTIONS[field])
        raise UsageError(where + text) from error


def made_tray(
    *,
    faults: list[str],
    tachos: tuple[Tacho, ...],
    noise_rad_s: float,
    shares: Mapping[str, float],
    clock: Mapping[str, Any],
    surroundings: Mapping[str, Any],
    **settings: Any,
) -> SimulatedTray:
    """The tray with these settings; see `simulation.tray.TraySettings`.

    Raises:
        UsageError: a setting is out of range, or a fault cannot be parsed.
    """
    from fantwin.simulation.errors import SimulationError  # noqa: PLC0415  loaded only by the commands that need it
    from fantwin.simulation.faults import parse_fault  # noqa: PLC0415
    from fantwin.simulation.plant import DeviceClock  # noqa: PLC0415
    from fantwin.simulation.surroundings import Surroundings  # noqa: PLC0415
    from fantwin.simulation.tacho import NoisyTacho, TachoSettings  # noqa: PLC0415
    from fantwin.simulation.tray import SimulatedTray, TraySettings  # noqa: PLC0415

    measured = TachoSettings(tachos, NoisyTacho(noise_rad_s), **shares)
    try:
        schedule = tuple(map(parse_fault, faults))
        around, device_clock = Surroundings(**surroundings), DeviceClock(**clock)
        return SimulatedTray(
            TraySettings(faults=schedule, tacho=measured, clock=device_clock, surroundings=around, **settings)
        )
    except SimulationError as error:
        raise UsageError(str(error)) from error


def measured_columns(names: list[str]) -> tuple[str, ...]:
    """The columns of `--measure`, in the order of `AUXILIARY`.

    Raises:
        UsageError: there is no such column.
    """
    known = [column.name for column in AUXILIARY]
    for name in names:
        if name not in known:
            raise UsageError(f"--measure {name}: known are {', '.join(known)}")
    return tuple(name for name in known if name in names)
