"""Fans of a server by Redfish. Nothing is written.

The parts: `client` asks, `listings` finds the objects of the fans, `fan_objects` says what is in them, `commands` where
the commands are. An object that cannot be read costs itself: its fan is missing in the sample, and health names its
path.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from fantwin.pipeline.errors import refusals
from fantwin.pipeline.sources.own_json import has, number_at
from fantwin.pipeline.sources.polling import DeviceError, PollingSource
from fantwin.pipeline.sources.redfish.client import RedfishClient
from fantwin.pipeline.sources.redfish.commands import FanCommands
from fantwin.pipeline.sources.redfish.config import RedfishConfig
from fantwin.pipeline.sources.redfish.fan_objects import FanObject
from fantwin.pipeline.sources.redfish.listings import ChassisFans, Listing, find_chassis
from fantwin.pipeline.sources.source import Reading, Rejected, SourceContext
from fantwin.schemas.channels import TEMPERATURE

POLLS_UNTIL_OTHER_SCHEMA = 10
"""polls without any speed after which the speeds are looked for in the other schemas"""


class FanThere(NamedTuple):
    """A fan of the controller and what it reads now; NaN where it gives none. called, place: what people see."""

    name: str
    called: str
    place: str
    rpm: float
    command: float


class RedfishSource(PollingSource):
    """A `SampleSource`."""

    def __init__(self, config: RedfishConfig, context: SourceContext) -> None:
        super().__init__(config, config.period_s)
        self._config = config
        self._fans = context.fans
        self._folder = context.folder
        self._units_per_rpm = context.units_per_rpm
        self._client: RedfishClient | None = None
        self._chassis: ChassisFans | None = None
        self._commands: FanCommands | None = None
        self._schema = ""
        self._polls_without_speed = 0

    @property
    def name(self) -> str:
        """The address, with the chassis."""
        return f"{self._config.address}{self._config.chassis}"

    @property
    def settings_to_check(self) -> str:
        """Settings that may not fit the controller."""
        return "source.fans, source.command"

    def connect(self) -> None:
        """Log in, and find the chassis. Raises UserError, too, where the password cannot be read."""
        config, verify = self._config, self._config.verify
        self._client = client = RedfishClient(
            config.address,
            verify if isinstance(verify, bool) else str(self._folder / verify),
            config.username,
            config.password(self._folder),
        )
        client.log_in()
        self._chassis, listing = self._one_of(find_chassis(client, config.chassis))
        self._schema, self._polls_without_speed = listing.schema, 0
        self.fans_called = ()
        self._commands = FanCommands(self._chassis, config.command)

    def read(self) -> Reading | Rejected:
        """Speeds and commands of the fans, and the temperature if asked for."""
        fans, speeds, commands = self._look()
        if not self.fans_called:
            self.fans_called = tuple((fan.called, fan.place) for fan in fans)
        if why := self._why_unusable(fans, commands):
            return why
        measured = {TEMPERATURE: (self._temperature_c(),) * len(fans)} if self._config.temperature else {}
        assert self._chassis is not None
        for line in self._chassis.unread.values():
            self.note("unread_objects", line)
        return Reading(command=commands, speed=tuple(rpm * self._units_per_rpm for rpm in speeds), measured=measured)

    def fans_there(self) -> tuple[list[FanThere], str]:
        """The fans of the controller, in its order, and why they cannot be watched; `connect` comes first."""
        fans, speeds, commands = self._look()
        why = self._why_unusable(fans, commands)
        found = [
            FanThere(next(iter(fan.keys), ""), fan.called, fan.place, rpm, command)
            for fan, rpm, command in zip(fans, speeds, commands, strict=True)
        ]
        return found, why.detail if why else ""

    def disconnect(self) -> None:
        """Log out."""
        client, self._client, self._chassis, self._commands = self._client, None, None, None
        if client is not None:
            client.close()

    def check(self) -> list[str]:
        """Problems before the start: the password cannot be read. The controller is not asked."""
        return refusals(lambda: self._config.password(self._folder))

    def _one_of(self, candidates: Sequence[ChassisFans]) -> tuple[ChassisFans, Listing]:
        """The chassis with the fans of the tray."""
        wanted = self._config.fans
        found = [(each, each.choose(wanted, self._config.speed)) for each in candidates]
        with_fans = [(chassis, listing) for chassis, listing in found if listing.fans]
        if wanted and len(with_fans) > 1:
            with_fans = [each for each in with_fans if _lacking(each[1].fans, wanted) == []]
        if len(with_fans) == 1:
            return with_fans[0]
        unread = [line for chassis, _ in found for line in chassis.unread.values()]
        if unread and not with_fans:
            raise DeviceError(unread[0])
        if self._config.chassis:
            raise DeviceError(
                f"{self._config.chassis} has no fans: let source.url end with the path of another chassis"
            )
        there = ", ".join(chassis.path for chassis, listing in found if listing.fans)
        raise DeviceError(f"chassis with fans: {there or 'none'}; let source.url end with the path of one")

    def _look(self) -> tuple[list[FanObject], tuple[float, ...], tuple[float, ...]]:
        """The fans of the tray, and their speeds (rpm) and commands."""
        chassis, commands = self._chassis, self._commands
        assert chassis is not None and commands is not None
        chassis.unread.clear()
        listing = chassis.listing(self._schema)
        fans = self._chosen(listing.fans)
        speeds = tuple(map(self._rpm, fans))
        self._polls_without_speed = self._polls_without_speed + 1 if all(map(math.isnan, speeds)) else 0
        if self._polls_without_speed > POLLS_UNTIL_OTHER_SCHEMA:
            self._polls_without_speed = 0
            self._schema = chassis.choose(self._config.fans, self._config.speed).schema or self._schema
        return fans, speeds, commands.values(fans, listing)

    def _chosen(self, fans: Sequence[FanObject]) -> list[FanObject]:
        assert self._chassis is not None
        unread = list(self._chassis.unread.values())
        if unread and all(fan.why_unread for fan in fans):
            raise DeviceError(unread[0])
        wanted = self._config.fans
        by_name: dict[str, FanObject] = {}
        for fan in fans:
            for key in fan.keys:
                by_name.setdefault(key, fan)
        if (lacking := _lacking(fans, wanted)) and not any(fan.why_unread for fan in fans):
            raise DeviceError(f"no fan {lacking[0]!r}; there are: {', '.join(by_name)}")
        missing = FanObject({}, why_unread="it cannot be read")
        chosen = [by_name.get(name, missing) for name in wanted] if wanted else list(fans)
        if self._fans and len(chosen) != self._fans:
            raise DeviceError(f"{len(chosen)} fans, this tray has {self._fans}: correct fans, or source.fans")
        return chosen

    def _rpm(self, fan: FanObject) -> float:
        config = self._config
        if config.speed:
            return number_at(fan.own, config.speed) if fan.is_measured else math.nan
        if config.rated_rpm and math.isnan(fan.rpm):
            return fan.percent / 100.0 * config.rated_rpm
        return fan.rpm

    def _gives_speed(self, fan: FanObject) -> bool:
        """Whether there is a place for its speed, also where it has no value now."""
        config = self._config
        if config.speed:
            return has(fan.own, config.speed)
        return bool(fan.rpm_at) or (config.rated_rpm is not None and fan.has_percent)

    def _why_unusable(self, fans: Sequence[FanObject], commands: Sequence[float]) -> Rejected | None:
        """Why there is no sample: the fans are off, or speed or command of all of them is nowhere."""
        there = [fan for fan in fans if not fan.why_unread]
        if there and not any(fan.is_measured for fan in there):
            return Rejected("fans_off", "all fans are off or absent (Status/State)", is_sample=True, setting="none")
        first = next(iter(there), None)
        if first is None:
            return None
        called = next(iter(first.keys), "a fan")
        if not any(map(self._gives_speed, there)):
            if any(fan.has_percent for fan in there) and not self._config.speed:
                why = "the controller gives per cent, no rpm: its fans cannot be judged without source.rated_rpm"
                return Rejected("unknown_speed", why, is_sample=True, setting="source.rated_rpm")
            why = f"the object of {called} has no speed in rpm: say where by source.speed; it has {first.numbers}"
            return Rejected("unknown_speed", why, is_sample=True, setting="source.speed")
        if all(map(math.isnan, commands)):
            assert self._commands is not None
            stated = (
                f"no number at {', '.join(self._config.command)}" if self._config.command else "no command is known"
            )
            pwms = f"; pwms: {', '.join(self._commands.pwms)}" if self._commands.pwms else ""
            why = f"{stated}: say where by source.command; {called} has {first.numbers}{pwms}"
            return Rejected("unknown_command", why, is_sample=True, setting="source.command")
        return None

    def _temperature_c(self) -> float:
        assert self._chassis is not None
        return self._chassis.temperature_c(self._config.temperature)


def _lacking(fans: Sequence[FanObject], wanted: Sequence[str]) -> list[str]:
    """The wanted names that no fan has."""
    there = {key for fan in fans for key in fan.keys}
    return [name for name in wanted if name not in there]
