"""Fans of a server by Redfish: the objects of the fans, in the older schema (Thermal) or the newer (ThermalSubsystem).

A speed is what is given in rpm. Redfish has no standard duty: the command is what `command` points to, by default the
percentage that the newer schema gives beside the speed. Nothing is written.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from fantwin.pipeline.errors import refusals
from fantwin.pipeline.extras import require
from fantwin.pipeline.sources.own_json import NothingThereError, value_at
from fantwin.pipeline.sources.polling import DeviceError, PollingSource
from fantwin.pipeline.sources.redfish.config import RedfishConfig
from fantwin.pipeline.sources.source import Reading, Rejected, SourceContext
from fantwin.schemas.channels import TEMPERATURE
from fantwin.schemas.fan_names import is_fan_name, is_one_short_line

if TYPE_CHECKING:
    from sushy.main import Sushy

Json = Mapping[str, Any]
PERIOD_S = 1.0
"""time between two readings: controllers are slow"""
TIMEOUT_S = 5.0
"""longest wait for the answer to a request"""


_NAMES = ("Name", "FanName", "MemberId", "Id")


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
        """Raises UserError if the extra is missing."""
        super().__init__(config, PERIOD_S)
        require("source redfish", "devices", "sushy")
        self._config = config
        self._fans = context.fans
        self._folder = context.folder
        self._units_per_rpm = context.units_per_rpm
        self._root: Sushy | None = None
        self._chassis: Json = {}

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
        import sushy  # noqa: PLC0415  slow to import
        from sushy.auth import BasicAuth, SessionOrBasicAuth  # noqa: PLC0415

        config = self._config
        logging.getLogger("sushy").setLevel(logging.CRITICAL)  # a failure is a line of this source already
        user, password = config.username, config.password(self._folder)
        if user and config.parts.scheme == "http":
            raise DeviceError(f"{config.address} would send the password in the clear: use https")
        # sushy takes 0 for its own number of attempts, and waits between them; the poller tries again by itself
        options: dict[str, Any] = {
            "verify": config.verify if isinstance(config.verify, bool) else str(self._folder / config.verify),
            "read_timeout": TIMEOUT_S,
            "connect_timeout": TIMEOUT_S,
            "server_side_retries": 1,
            "server_side_retries_delay": 0.01,
        }

        def log_in() -> Any:
            return sushy.Sushy(
                config.address,
                auth=SessionOrBasicAuth(user, password) if user else BasicAuth("", ""),
                **options,
            )

        self._root = self._asked(log_in)
        self._chassis = self._find_chassis()

    def read(self) -> Reading | Rejected:
        """Speeds and commands of the fans, and the temperature if asked for."""
        fans = self._chosen(self._fan_objects())
        self.fans_called = tuple((_name(fan), _place(fan)) for fan in fans)
        command = tuple(_number(fan, self._config.command) for fan in fans)
        if all(map(math.isnan, command)):
            return Rejected(
                "unknown_command",
                f"no fan has a number at {self._config.command}: say where its command is",
                is_sample=True,
                setting="source.command",
            )
        measured = {TEMPERATURE: (self._temperature_c(),) * len(fans)} if self._config.temperature else {}
        speed = tuple(_rpm(fan) * self._units_per_rpm for fan in fans)
        return Reading(command=command, speed=speed, measured=measured)

    def fans_there(self) -> list[FanThere]:
        """The fans of the controller, in its order; `connect` comes first."""
        found = [(next((str(fan[key]) for key in _NAMES if fan.get(key)), ""), fan) for fan in self._fan_objects()]
        return [
            FanThere(name, _name(fan), _place(fan), _rpm(fan), _number(fan, self._config.command))
            for name, fan in found
        ]

    def disconnect(self) -> None:
        """Log out."""
        root, self._root = self._root, None
        connector = getattr(root, "_conn", None)
        if connector is not None:
            auth = getattr(connector, "_auth", None)
            if auth is not None:
                auth.close()
            connector.close()

    def check(self) -> list[str]:
        """Problems before the start: the password cannot be read. The controller is not asked."""
        return refusals(lambda: self._config.password(self._folder))

    def _asked(self, request: Any) -> Any:
        """Send a request and return the answer. Raises DeviceError, whose text has no credentials."""
        from sushy import exceptions  # noqa: PLC0415

        try:
            return request()
        except exceptions.AccessError as error:
            raise DeviceError("user or password is refused, or lacks rights", is_lost=True) from error
        except exceptions.HTTPError as error:
            raise DeviceError(f"refused with HTTP status {error.status_code}") from error
        except exceptions.ConnectionError as error:
            text = str(error)
            if "CERTIFICATE_VERIFY_FAILED" in text or "certificate" in text.lower():
                why = "its certificate cannot be verified: name the authority by source.verify"
            else:
                why = f"does not answer within {TIMEOUT_S:g} s, or cannot be reached"
            raise DeviceError(f"{why}; waiting for it", is_lost=True) from error
        except (exceptions.SushyError, ValueError) as error:
            raise DeviceError(f"no Redfish service: {type(error).__name__}") from error

    def _get(self, path: str) -> Json:
        root = self._root
        assert root is not None
        # The connection of sushy, which knows the fans of the older schema only.
        found = self._asked(lambda: root._conn.get(path).json())
        if not isinstance(found, Mapping):
            raise DeviceError(f"{path} is no object")
        return found

    def _find_chassis(self) -> Json:
        paths = filter(None, map(_link, _list(self._get("/redfish/v1/Chassis"), "Members")))
        found = {
            path.rstrip("/"): chassis
            for path in paths
            if {"ThermalSubsystem", "Thermal"} & (chassis := self._get(path)).keys()
        }
        wanted = [self._config.chassis] if self._config.chassis else list(found)
        if len(wanted) == 1 and wanted[0] in found:
            return found[wanted[0]]
        raise DeviceError(f"chassis with fans: {', '.join(found) or 'none'}; let source.url end with the path of one")

    def _fan_objects(self) -> list[Json]:
        subsystem = _link(self._chassis.get("ThermalSubsystem"))
        if not subsystem:
            return _list(self._get(_link(self._chassis.get("Thermal"))), "Fans")
        fans = _list(self._get(_link(self._get(subsystem).get("Fans"))), "Members")
        return [fan if len(fan) > 1 else self._get(_link(fan)) for fan in fans]  # some controllers expand the members

    def _chosen(self, fans: Sequence[Json]) -> list[Json]:
        wanted = self._config.fans
        by_name: dict[str, Json] = {}
        for fan in fans:
            for key in _NAMES:
                if name := fan.get(key):
                    by_name.setdefault(str(name), fan)
        if lacking := [name for name in wanted if name not in by_name]:
            raise DeviceError(f"no fan {lacking[0]!r}; there are: {', '.join(by_name)}")
        chosen = [by_name[name] for name in wanted] if wanted else list(fans)
        if len(chosen) != self._fans:
            raise DeviceError(f"{len(chosen)} fans, this tray has {self._fans}: correct fans, or source.fans")
        return chosen

    def _temperature_c(self) -> float:
        wanted = self._config.temperature
        subsystem = _link(self._chassis.get("ThermalSubsystem"))
        if not subsystem:
            sensors = _list(self._get(_link(self._chassis.get("Thermal"))), "Temperatures")
            return next((_number(each, "/ReadingCelsius") for each in sensors if each.get("Name") == wanted), math.nan)
        metrics = self._get(_link(self._get(subsystem).get("ThermalMetrics")))
        return _number(metrics, f"/TemperatureSummaryCelsius/{wanted}/Reading")


def _link(value: Any) -> str:
    return str(value.get("@odata.id", "")) if isinstance(value, Mapping) else ""


def _list(value: Json, key: str) -> list[Json]:
    found = value.get(key)
    return [each for each in found if isinstance(each, Mapping)] if isinstance(found, list) else []


def _name(fan: Json) -> str:
    """What the controller calls a fan; empty where that can be no name."""
    return next((name for key in ("Name", "FanName") if is_fan_name(name := str(fan.get(key, "")))), "")


def _place(fan: Json) -> str:
    """Where the controller says it is, by the label on the chassis or by the context; may be empty."""
    location = fan.get("Location")
    part = location.get("PartLocation") if isinstance(location, Mapping) else None
    label = part.get("ServiceLabel") if isinstance(part, Mapping) else None
    places = (str(each) for each in (label, fan.get("PhysicalContext")) if each)
    return next(filter(is_one_short_line, places), "")


def _number(value: Any, pointer: str) -> float:
    """The number at a JSON pointer; NaN if there is none."""
    try:
        value = value_at(value, pointer)
    except NothingThereError:
        return math.nan
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number else math.nan


def _rpm(fan: Json) -> float:
    """NaN where a fan gives no rpm, or is absent."""
    status = fan.get("Status")
    if isinstance(status, Mapping) and status.get("State") in ("Absent", "Disabled"):
        return math.nan
    if not math.isnan(rpm := _number(fan, "/SpeedPercent/SpeedRPM")):
        return rpm
    return _number(fan, "/Reading") if fan.get("ReadingUnits") == "RPM" else math.nan
