"""Where the command of each fan is: Redfish has no standard duty, so it is a set-point, a sensor or a vendor's key.

OpenBMC shows the pwm of a fan as a sensor beside its tacho (`fanpwm_SYS_FAN1_PWM`, `fantach_SYS_FAN1_RPM`). Such a
pwm is taken where its name is that of the fan, or where the controllers of OpenBMC say which pwm they drive by which
tacho. A common number alone is no evidence: on some boards pwm1 drives fan1 and fan2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from fantwin.pipeline.sources.own_json import has, number_at
from fantwin.pipeline.sources.polling import DeviceError
from fantwin.pipeline.sources.redfish.fan_objects import (
    SET_POINT,
    FanObject,
    is_pwm_name,
    last_part,
    stem,
)
from fantwin.pipeline.sources.redfish.listings import ChassisFans, Listing, plain

READING = "/Reading"


class CommandPlace(NamedTuple):
    """Where a command is: in the resource at a path, in a pwm listed beside the fans, or else in the fan's object."""

    pointer: str = ""
    path: str = ""
    pwm: str = ""


class FanCommands:
    """The commands of chosen fans of a chassis."""

    def __init__(self, chassis: ChassisFans, stated: Sequence[str]) -> None:
        """stated: see source.command."""
        self._chassis = chassis
        self._stated = stated
        self._places: tuple[CommandPlace | None, ...] = ()
        self._were_read: tuple[bool, ...] = ()
        """whether each fan could be read when the places were looked for"""
        self.pwms: tuple[str, ...] = ()
        """names of the pwms that are there"""

    def values(self, fans: Sequence[FanObject], listing: Listing) -> tuple[float, ...]:
        """The command of each fan, NaN where it is not known. Raises DeviceError where a stated one is not there."""
        are_read = tuple(not fan.why_unread for fan in fans)
        if are_read != self._were_read:
            self._places, self._were_read = self._find(fans, listing), are_read
        paths = dict.fromkeys(place.path for place in self._places if place and place.path)
        resources = {path: self._chassis.read(path) for path in paths}
        listed = {key: pwm.percent for pwm in listing.pwms for key in pwm.keys}

        def value(fan: FanObject, place: CommandPlace | None) -> float:
            if place is None or fan.why_unread:  # with a command alone its tacho would seem to be silent
                return math.nan
            if place.pwm:
                return listed.get(place.pwm, math.nan)
            return number_at(resources[place.path] if place.path else fan.own, place.pointer)

        return tuple(map(value, fans, self._places))

    def _find(self, fans: Sequence[FanObject], listing: Listing) -> tuple[CommandPlace | None, ...]:
        if self._stated:
            return self._stated_places(fans, listing)
        if fans and all(has(fan.own, SET_POINT) for fan in fans):
            return (CommandPlace(SET_POINT),) * len(fans)
        pwms = {key: CommandPlace(pwm=key) for pwm in listing.pwms for key in pwm.keys[:1]}
        if not pwms:
            sensors = [path for path in self._chassis.sensor_paths() if is_pwm_name(last_part(path))]
            pwms = {last_part(path): CommandPlace(READING, path) for path in sensors}
        self.pwms = tuple(pwms)
        outputs = self._chassis.pwm_outputs() if pwms else {}
        return tuple(_set_point(fan) or _like(fan, pwms) or _driven(fan, pwms, outputs) for fan in fans)

    def _stated_places(self, fans: Sequence[FanObject], listing: Listing) -> tuple[CommandPlace | None, ...]:
        stated = tuple(self._stated) * (len(fans) if len(self._stated) == 1 else 1)
        if len(stated) != len(fans):
            raise DeviceError(f"source.command names {len(stated)}: give one for all fans, or {len(fans)}")
        return tuple(self._stated_place(each, listing) for each in stated)

    def _stated_place(self, stated: str, listing: Listing) -> CommandPlace:
        path, _, pointer = stated.partition("#")
        if path.startswith("/redfish/"):
            return CommandPlace(pointer or READING, path)
        if stated.startswith("/"):
            return CommandPlace(stated)
        if any(stated in pwm.keys for pwm in listing.pwms):
            return CommandPlace(pwm=stated)
        if found := self._chassis.sensor_called(path):
            return CommandPlace(pointer or READING, found)
        there = ", ".join(last_part(each) for each in self._chassis.sensor_paths() if is_pwm_name(last_part(each)))
        raise DeviceError(f"no sensor {stated!r} for the command; pwms there: {there or 'none'}")


def _set_point(fan: FanObject) -> CommandPlace | None:
    return CommandPlace(SET_POINT) if has(fan.own, SET_POINT) else None


def _like(fan: FanObject, pwms: dict[str, CommandPlace]) -> CommandPlace | None:
    stems = set(filter(None, map(stem, fan.keys)))
    found = [place for name, place in pwms.items() if stem(name) in stems]
    return found[0] if len(found) == 1 else None


def _driven(fan: FanObject, pwms: dict[str, CommandPlace], outputs: dict[str, str]) -> CommandPlace | None:
    wanted = {outputs.get(plain(key)) for key in fan.keys} - {None}
    found = [place for name, place in pwms.items() if plain(name) in wanted]
    return found[0] if len(found) == 1 else None
