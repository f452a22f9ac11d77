"""Where a controller lists its fans: Thermal, ThermalSubsystem, EnvironmentMetrics, or as sensors of the chassis.

Controllers have several of these at once, and speeds in some of them. That one is read in which most of the wanted fans
have a speed; of several, the one that takes the fewest requests.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from fantwin.pipeline.sources.own_json import found_at, number_at
from fantwin.pipeline.sources.polling import DeviceError
from fantwin.pipeline.sources.redfish.client import ROOT, RedfishClient
from fantwin.pipeline.sources.redfish.fan_objects import (
    FanObject,
    is_pwm_name,
    last_part,
    link,
    listed,
    rpm_at,
)

Json: TypeAlias = Mapping[str, Any]
MOST_SENSORS = 64
"""sensors that are asked one by one"""
MEMBERS_HOLD = 60
"""readings after which the members of a collection are asked for again: fans are exchanged while a server runs"""
SCHEMAS = ("Thermal", "ThermalSubsystem", "EnvironmentMetrics", "Sensors")
"""keys of a chassis that lead to its fans, those that take fewer requests first"""


@dataclass
class Listing:
    """The fans that one schema lists, and the pwms that it lists beside them."""

    schema: str
    fans: list[FanObject]
    pwms: list[FanObject] = field(default_factory=list[FanObject])

    def speeds(self, wanted: Sequence[str], speed: str) -> int:
        """How many of the wanted fans have a speed now; speed: see source.speed."""
        fans = [each for each in self.fans if not wanted or set(each.keys) & set(wanted)]
        return sum(not math.isnan(number_at(each.own, speed) if speed else each.rpm) for each in fans)


class ChassisFans:
    """The fans of one chassis. Objects that cannot be read are left out and named in `unread`."""

    def __init__(self, client: RedfishClient, path: str, chassis: Json, *, expands: bool) -> None:
        """chassis: its object. expands: the controller gives the members of a collection in one answer."""
        self._client = client
        self.path = path
        self._chassis = chassis
        self._expanding = ("?$expand=.", "") if expands else ("",)
        """queries by which a collection may give its members themselves; some controllers do so unasked"""
        self.unread: dict[str, str] = {}
        """why, by path; since it was last cleared"""
        self._links: dict[str, str] = {}
        """what was found to lead where, by resource and key"""
        self._paths: dict[str, tuple[list[str], int]] = {}
        """members of collections, and for how many readings they still hold"""
        self._known: dict[str, Json] = {}
        """members of collections as they were last read, by path"""

    def has_schemas(self) -> bool:
        """Whether it may have fans."""
        return any(link(self._chassis.get(schema)) for schema in SCHEMAS)

    def choose(self, wanted: Sequence[str], speed: str) -> Listing:
        """The listing that has most of the wanted fans' speeds."""
        best = Listing("", [])
        for schema in SCHEMAS:
            if not link(self._chassis.get(schema)) or (schema == "Sensors" and best.speeds(wanted, speed)):
                continue
            found = self.listing(schema)
            if (found.speeds(wanted, speed), len(found.fans)) > (best.speeds(wanted, speed), len(best.fans)):
                best = found
            if best.fans and best.speeds(wanted, speed) >= max(len(wanted), len(best.fans) if not wanted else 0):
                break
        return best

    def listing(self, schema: str) -> Listing:
        """The fans by one schema. Raises DeviceError if the connection is lost."""
        ways: dict[str, Callable[[], list[FanObject]]] = {
            "Thermal": lambda: [FanObject(each) for each in listed(self._resource("Thermal"), "Fans")],
            "ThermalSubsystem": self._newer,
            "EnvironmentMetrics": self._metrics,
            "Sensors": lambda: [self._member(path) for path in self._tachos()[:MOST_SENSORS]],
        }
        found = ways[schema]()
        are_mixed = any(each.rpm_at for each in found)
        fans = [each for each in found if not (are_mixed and each.is_pwm)]
        return Listing(schema, fans, [each for each in found if are_mixed and each.is_pwm])

    def sensor_paths(self) -> list[str]:
        """Paths of the sensors of the chassis; none if they cannot be listed."""
        return self._member_paths(link(self._chassis.get("Sensors")))

    def sensor(self, path: str) -> Json:
        """A sensor, or any resource; without anything where it cannot be read."""
        return self.read(path.partition("#")[0])

    def read(self, path: str) -> Json:
        """An object; without anything, and noted, where it cannot be read. Raises DeviceError if the connection is
        lost."""
        if not path:
            return {}
        try:
            return self._client.get(path)
        except DeviceError as error:
            if error.is_lost:
                raise
            self.unread[path] = str(error)
            return {}

    def temperature_c(self, wanted: str) -> float:
        """The temperature by name, NaN if there is none."""
        found = math.nan
        if link(self._chassis.get("ThermalSubsystem")):
            metrics = self.read(self._link("ThermalSubsystem", "ThermalMetrics"))
            found = number_at(metrics, f"/TemperatureSummaryCelsius/{wanted}/Reading")
            for each in listed(metrics, "TemperatureReadingsCelsius") if math.isnan(found) else ():
                if wanted in (each.get("DeviceName"), last_part(str(each.get("DataSourceUri", "")))):
                    return number_at(each, "/Reading")
        if math.isnan(found) and link(self._chassis.get("Thermal")):
            sensors = listed(self._resource("Thermal"), "Temperatures")
            found = next((number_at(each, "/ReadingCelsius") for each in sensors if each.get("Name") == wanted), found)
        if math.isnan(found) and (path := self.sensor_called(wanted)):
            found = number_at(self.read(path), "/Reading")
        return found

    def sensor_called(self, name: str) -> str:
        """The path of the sensor of this id; empty if there is none."""
        if name not in self._links:
            self._links[name] = next((each for each in self.sensor_paths() if last_part(each) == name), "")
        return self._links[name]

    def pwm_outputs(self) -> dict[str, str]:
        """The pwm that drives the fan of each tacho, by name, as the controllers of OpenBMC are set."""
        found: dict[str, str] = {}
        for manager in listed(self.read(f"{ROOT}Managers"), "Members"):
            controllers = found_at(self.read(link(manager)), "/Oem/OpenBmc/Fan/FanControllers")
            for each in controllers.values() if isinstance(controllers, Mapping) else ():
                outputs = each.get("Outputs") if isinstance(each, Mapping) else None
                if isinstance(outputs, list) and len(outputs) == 1:
                    found |= {plain(name): plain(str(outputs[0])) for name in map(str, each.get("Inputs") or ())}
        return found

    def _resource(self, schema: str) -> Json:
        return self.read(link(self._chassis.get(schema)))

    def _link(self, schema: str, key: str) -> str:
        name = f"{schema}/{key}"
        if not self._links.get(name):
            self._links[name] = link(self._resource(schema).get(key))
        return self._links[name]

    def _newer(self) -> list[FanObject]:
        fans = list(self._members(self._link("ThermalSubsystem", "Fans")))
        for fan in fans:
            if fan.why_unread or not fan.is_measured or not math.isnan(number_at(fan.own, rpm_at(fan.own))):
                continue
            path = str(found_at(fan.own, "/SpeedPercent/DataSourceUri") or "")
            if path and not is_pwm_name(last_part(path)):
                fan.sensor = self.sensor(path)
        return fans

    def _metrics(self) -> list[FanObject]:
        """Excerpts in one answer: their units are those of the key, and rpm only where it is said."""
        return [
            FanObject(
                {
                    "Name": str(each.get("DeviceName") or last_part(str(each.get("DataSourceUri", "")))),
                    "Id": last_part(str(each.get("DataSourceUri", ""))),
                    "SpeedPercent": {key: each[key] for key in ("Reading", "SpeedRPM") if key in each},
                }
            )
            for each in listed(self._resource("EnvironmentMetrics"), "FanSpeedsPercent")
        ]

    def _tachos(self) -> list[str]:
        return [path for path in self.sensor_paths() if _is_tacho(last_part(path))]

    def _member_paths(self, path: str) -> list[str]:
        """The paths of the members of a collection, as they were last read."""
        found, left = self._paths.get(path, ([], 0))
        if not left:
            found, left = [each for each in map(link, listed(self.read(path), "Members")) if each], MEMBERS_HOLD
        self._paths[path] = (found, left - 1 if found else 0)
        return found

    def _members(self, path: str) -> Iterator[FanObject]:
        """The members of a collection. One that cannot be read is there all the same, as it was last known."""
        if not path:
            return
        for query in self._expanding:
            members = listed(self.read(f"{path}{query}"), "Members")
            if any(len(each) > 1 for each in members):
                self._expanding = (query,)
                yield from (self._member(link(each)) if len(each) == 1 else FanObject(each) for each in members)
                return
            self.unread.pop(f"{path}{query}", None)
        self._expanding = ()
        for each in self._member_paths(path):
            yield self._member(each)

    def _member(self, path: str) -> FanObject:
        found = self.read(path)
        if found:
            self._known[path] = found
            return FanObject(found)
        return FanObject(
            _names_of(self._known.get(path, {"Id": last_part(path)})), why_unread=self.unread.get(path, "")
        )


def plain(name: str) -> str:
    """A name without the marks in which D-Bus, sensors and settings differ: `Fan 1` and `fantach_Fan_1` are `fan1`."""
    text = name.lower().removeprefix("fantach_").removeprefix("fanpwm_")
    return "".join(each for each in text if each.isalnum())


def _names_of(value: Json) -> Json:
    return {key: value[key] for key in ("Name", "Id", "MemberId", "FanName", "@odata.id") if key in value}


def _is_tacho(name: str) -> bool:
    return ("tach" in name.lower() or "fan" in name.lower()) and not is_pwm_name(name)


def find_chassis(client: RedfishClient, path: str) -> list[ChassisFans]:
    """The chassis that may have fans: the one at the path alone, if it is given. Those that cannot be read are passed
    over.

    Raises:
        DeviceError: the connection is lost, or the named one cannot be read.
    """
    root = client.get(ROOT)
    expand = found_at(root, "/ProtocolFeaturesSupported/ExpandQuery/NoLinks") is True
    if path:
        found = ChassisFans(client, path, client.get(path), expands=expand)
        return [found] if found.has_schemas() else []
    collection = client.get(link(root.get("Chassis")) or f"{ROOT}Chassis")
    paths = [path.rstrip("/") for path in map(link, listed(collection, "Members")) if path]
    problems: list[DeviceError] = []
    all_found: list[ChassisFans] = []
    for each in paths:
        try:
            all_found.append(ChassisFans(client, each, client.get(each), expands=expand))
        except DeviceError as error:
            if error.is_lost:
                raise
            problems.append(error)
    if problems and not all_found:
        raise problems[0]
    return [each for each in all_found if each.has_schemas()]
