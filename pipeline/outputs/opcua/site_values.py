"""The value of every node of the site, as it is now."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

import time
from collections.abc import Mapping
from datetime import UTC, datetime

from asyncua import ua

from fantwin.pipeline.outputs.opcua.encoding import ALARM, SharedValue, data_value
from fantwin.pipeline.outputs.opcua.events import condition_fields
from fantwin.pipeline.outputs.opcua.fan_values import GOOD, FanValues
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.messages import ModelCard
from fantwin.schemas.twin_card import CardError, TwinCard
from fantwin.schemas.units import RAD_S_PER_UNIT
from fantwin.scoring.alarms.current_alarms import CurrentAlarm

UNIT_RPM = ua.EUInformation(
    NamespaceUri="http://www.opcfoundation.org/UA/units/un/cefact",
    UnitId=ua.Int32(5394509),  # "RPM" of UN/CEFACT
    DisplayName=ua.LocalizedText("r/min"),
    Description=ua.LocalizedText("revolutions per minute"),
)
_CACHED = 1024
_UNSHELVE_TIME = "ShelvingState/UnshelveTime"


class SiteValues:
    """In the thread of the server only, but for `newest`."""

    def __init__(self, model: SiteModel, namespace: int) -> None:
        self._model, self._namespace = model, namespace
        self._values = FanValues()
        self._fields: dict[Fan, tuple[CurrentAlarm | None, Mapping[str, ua.Variant]]] = {}
        self._ranges: dict[str, tuple[ModelCard | None, float]] = {}

    def newest(self) -> FanValues:
        """Of all fans; in any thread."""
        return FanValues(self._model.trays_now(), self._model.every_fan(), self._values)

    def use(self, values: FanValues) -> None:
        """Show these from now on."""
        self._values = values

    def of(self, fan: Fan, path: str) -> SharedValue:
        """The value of a node. path: below its fan."""
        now = datetime.now(UTC)
        name, _, below = path.partition("/")
        if name == ALARM:
            return self._of_condition(fan, below, now)
        if below:
            top = ua.Range(Low=ua.Double(0.0), High=ua.Double(self._highest_rpm(fan.tray)))
            value = ua.Variant(top if below == "EURange" else UNIT_RPM, ua.VariantType.ExtensionObject)
            return data_value(value, GOOD, 0, now)
        found = self._values.of(fan, name)
        return data_value(ua.Variant(found.value), found.status, found.t_ns, now)

    def _of_condition(self, fan: Fan, field: str, now: datetime) -> SharedValue:
        current = self._model.current_alarm(fan)
        known = self._fields.get(fan)
        if known is None or known[0] is not current or field == _UNSHELVE_TIME:
            known = (current, condition_fields(fan, current, time.time_ns(), self._namespace))
            if len(self._fields) >= _CACHED:
                self._fields.clear()
            self._fields[fan] = known
        return data_value(known[1][field], GOOD, current.newest.t_ns if current else 0, now)

    def _highest_rpm(self, tray: str) -> float:
        """The highest speed to be expected: that of the twin's training data, or else what the tray may report."""
        card = self._model.twin(tray)
        known = self._ranges.get(tray)
        if known is None or known[0] is not card:
            known = self._ranges[tray] = (card, self._found_rpm(tray, card))
        return known[1]

    def _found_rpm(self, tray: str, card: ModelCard | None) -> float:
        try:
            top_rad_s = TwinCard.from_json(card.card_json).top_speed_rad_s if card else 0.0
        except CardError:  # of a version that this one does not know
            top_rad_s = 0.0
        config = self._model.tray(tray)
        if not top_rad_s and config is not None:
            top_rad_s = config.speed_max * RAD_S_PER_UNIT[config.speed_unit]
        return round(top_rad_s / RAD_S_PER_UNIT["rpm"], 1)
