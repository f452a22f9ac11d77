"""The site in Home Assistant: MQTT discovery by device, one for each fan and one for the site.

https://www.home-assistant.io/integrations/mqtt/#device-discovery-payload, as of Home Assistant 2024.11 to 2026.11. A
device is one retained message on PREFIX/device/NODE/OBJECT/config; an empty one removes it with its entities.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.mqtt.config import MqttConfig
from fantwin.pipeline.outputs.mqtt.outbox import text_of
from fantwin.pipeline.outputs.mqtt.topics import Topics
from fantwin.pipeline.site.fleet import Fan, FanGroup
from fantwin.schemas.topics import ALL_TRAYS

ACKNOWLEDGE = "acknowledge"
DISCOVERY_PREFIX = "homeassistant"
"""where Home Assistant looks for devices"""
SITE_DEVICE = "site"
ONLINE, OFFLINE = "online", "offline"
_QOS = 1
_OPTIONS = [group.replace("_", " ") for group in FanGroup]


class HomeAssistant:
    """The devices of the fans of the trays that the configuration names."""

    def __init__(self, config: MqttConfig, topics: Topics, trays: Sequence[TrayConfig], page: str = "") -> None:
        """page: address of the operators' page; empty: there is none."""
        self._topics = topics
        self._link = {"configuration_url": page} if page else {}
        self._can_acknowledge = ACKNOWLEDGE in config.accept
        self._availability = {
            "availability_topic": topics.status,
            "payload_available": ONLINE,
            "payload_not_available": OFFLINE,
        }
        node = re.sub(r"[^A-Za-z0-9_-]", "_", topics.root)
        self._node = node if topics.instance == ALL_TRAYS else f"{node}_{topics.instance}"
        self._path = f"{DISCOVERY_PREFIX}/device/{self._node}"
        chosen = [tray for tray in trays if tray.name in config.home_assistant]
        self._fans = [(Fan(tray.name, number), tray) for tray in chosen for number in range(tray.fans)]

    def messages(self) -> Mapping[str, str]:
        """The text of each device by its topic."""
        devices = {SITE_DEVICE: self._site()}
        devices |= {f"{fan.tray}-{fan.number}": self._fan(fan, tray) for fan, tray in self._fans}
        return {f"{self._path}/{name}/config": text_of(device) for name, device in devices.items()}

    def _site(self) -> dict[str, Any]:
        def count(key: str, words: str, icon: str) -> dict[str, Any]:
            return self._value(SITE_DEVICE, self._topics.summary, key, words, icon, state_class="measurement")

        running = {
            **self._entity(SITE_DEVICE, "running", "binary_sensor", "Running"),
            "device_class": "connectivity",
            "entity_category": "diagnostic",
            "state_topic": self._topics.status,
            "payload_on": ONLINE,
            "payload_off": OFFLINE,
        }
        entities = {
            "running": running,
            "in_alarm": count("in_alarm", "Fans in alarm", "mdi:fan-alert"),
            "not_judged": count("not_judged", "Fans not judged", "mdi:fan-off"),
        }
        return self._device(SITE_DEVICE, {"name": f"Fans of {self._topics.site}", "model": "site"}, entities)

    def _fan(self, fan: Fan, tray: TrayConfig) -> dict[str, Any]:
        name, topic = f"{fan.tray}-{fan.number}", self._topics.state(fan)

        def number(key: str, words: str, icon: str, precision: int, **more: str) -> dict[str, Any]:
            more |= {"state_class": "measurement"}
            return self._value(name, topic, key, words, icon, suggested_display_precision=precision, **more)

        problem = {
            **self._entity(name, "problem", "binary_sensor", "Problem"),
            **self._availability,
            "device_class": "problem",
            "state_topic": topic,
            "value_template": "{{ 'ON' if value_json.in_alarm else 'OFF' if value_json.judged else None }}",
            "json_attributes_topic": self._topics.alarm(fan),
            "json_attributes_template": "{{ (value_json or {}) | tojson }}",
        }
        in_unit, diagnostic = {"unit_of_measurement": tray.speed_unit}, {"entity_category": "diagnostic"}
        entities = {
            "problem": problem,
            "state": {
                **self._value(name, topic, "group", "State", "mdi:fan", device_class="enum", options=_OPTIONS),
                "value_template": "{{ value_json.group | replace('_', ' ') }}",
                "json_attributes_topic": topic,
                "json_attributes_template": "{{ {'in words': value_json.state, 'since': value_json.since} | tojson }}",
            },
            "speed": number("speed", "Speed", "mdi:fan", 0, **in_unit),
            "predicted_speed": number(
                "predicted_speed", "Speed of the healthy twin", "mdi:fan-auto", 0, **in_unit, **diagnostic
            ),
            "score": number("score", "Score (1 is at the limit)", "mdi:gauge", 2, **diagnostic),
        }
        if self._can_acknowledge:
            entities[ACKNOWLEDGE] = {
                **self._entity(name, ACKNOWLEDGE, "button", "Acknowledge"),
                **self._availability,
                "command_topic": self._topics.request(fan.tray, fan.number),
                "payload_press": text_of({"action": ACKNOWLEDGE, "comment": "from Home Assistant"}),
                "icon": "mdi:check",
            }
        known = tray.fan[fan.number]
        about = {"name": known.name or f"{fan.tray} fan {fan.number}", "model": "fan"}
        about |= {"via_device": f"{self._node}-{SITE_DEVICE}"}
        about |= {"suggested_area": known.place} if known.place else {}
        return self._device(name, about, entities)

    def _device(self, name: str, about: dict[str, Any], entities: dict[str, Any]) -> dict[str, Any]:
        return {
            "device": {"identifiers": [f"{self._node}-{name}"], "manufacturer": "fantwin", **self._link, **about},
            "origin": {"name": "fantwin", "sw_version": version("fantwin")},
            "components": entities,
            "qos": _QOS,
        }

    def _value(self, device: str, topic: str, key: str, words: str, icon: str, **more: Any) -> dict[str, Any]:
        """A sensor that shows a value of a topic."""
        shown = {"state_topic": topic, "value_template": f"{{{{ value_json.{key} }}}}", "icon": icon}
        return self._entity(device, key, "sensor", words) | self._availability | shown | more

    def _entity(self, device: str, key: str, platform: str, words: str) -> dict[str, Any]:
        return {"platform": platform, "unique_id": f"{self._node}-{device}-{key}", "name": words}
