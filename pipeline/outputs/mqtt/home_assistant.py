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
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.topics import ALL_TRAYS

ACKNOWLEDGE = "acknowledge"
DISCOVERY_PREFIX = "homeassistant"
"""where Home Assistant looks for devices"""
SITE_DEVICE = "site"
ONLINE, OFFLINE = "online", "offline"
MOST_FANS = 64
"""fans that are devices where nobody has chosen trays: with thousands of entities, Home Assistant becomes slow"""
_QOS = 1


class HomeAssistant:
    """The devices of the fans that the configuration chooses.

    Attributes:
        left_out: fans that have no device because there are too many.
    """

    def __init__(self, config: MqttConfig, topics: Topics, trays: Sequence[TrayConfig]) -> None:
        self._topics = topics
        self._can_acknowledge = ACKNOWLEDGE in config.accept
        node = re.sub(r"[^A-Za-z0-9_-]", "_", topics.root)
        self._node = node if topics.instance == ALL_TRAYS else f"{node}_{topics.instance}"
        self._path = f"{DISCOVERY_PREFIX}/device/{self._node}"
        chosen = config.home_assistant_trays or [tray.name for tray in trays]
        of_chosen = [tray for tray in trays if tray.name in chosen]
        fans = [(Fan(tray.name, number), tray.speed_unit) for tray in of_chosen for number in range(tray.fans)]
        self._fans = fans if config.home_assistant_trays else fans[:MOST_FANS]
        self.left_out = len(fans) - len(self._fans)

    def messages(self) -> Mapping[str, str]:
        """The text of each device by its topic."""
        devices = {SITE_DEVICE: self._site()}
        devices |= {f"{fan.tray}-{fan.number}": self._fan(fan, unit) for fan, unit in self._fans}
        return {f"{self._path}/{name}/config": text_of(device) for name, device in devices.items()}

    def _site(self) -> dict[str, Any]:
        def count(name: str, key: str, icon: str) -> dict[str, Any]:
            return self._of_site(key, "sensor", name) | {
                "state_topic": self._topics.summary,
                "value_template": f"{{{{ value_json.{key} }}}}",
                "state_class": "measurement",
                "icon": icon,
                **self._availability(),
            }

        running = self._of_site("running", "binary_sensor", "Running") | {
            "device_class": "connectivity",
            "entity_category": "diagnostic",
            "state_topic": self._topics.status,
            "payload_on": ONLINE,
            "payload_off": OFFLINE,
        }
        entities = {
            "running": running,
            "in_alarm": count("Fans in alarm", "in_alarm", "mdi:fan-alert"),
            "not_judged": count("Fans not judged", "not_judged", "mdi:fan-off"),
        }
        return self._device(SITE_DEVICE, {"name": f"Fans of {self._topics.site}", "model": "site"}, entities)

    def _fan(self, fan: Fan, unit: str) -> dict[str, Any]:
        name = f"{fan.tray}-{fan.number}"

        def entity(key: str, platform: str, words: str, **more: Any) -> dict[str, Any]:
            base = {"platform": platform, "unique_id": f"{self._node}-{name}-{key}", "name": words}
            return base | self._availability() | more

        def number(key: str, words: str, precision: int, **more: Any) -> dict[str, Any]:
            more |= {"state_class": "measurement", "suggested_display_precision": precision}
            template = f"{{{{ value_json.{key} }}}}"
            return entity(key, "sensor", words, state_topic=self._topics.state(fan), value_template=template, **more)

        entities = {
            "problem": entity(
                "problem",
                "binary_sensor",
                "Problem",
                device_class="problem",
                state_topic=self._topics.state(fan),
                value_template="{{ 'ON' if value_json.in_alarm else 'OFF' if value_json.judged else None }}",
                json_attributes_topic=self._topics.alarm(fan),
                json_attributes_template="{{ (value_json or {}) | tojson }}",
            ),
            "state": entity(
                "state",
                "sensor",
                "State",
                state_topic=self._topics.state(fan),
                value_template="{{ value_json.state }}",
                icon="mdi:fan",
            ),
            "speed": number("speed", "Speed", 0, unit_of_measurement=unit, icon="mdi:fan"),
            "predicted_speed": number(
                "predicted_speed", "Speed of the healthy twin", 0, unit_of_measurement=unit, icon="mdi:fan-auto"
            ),
            "score": number("score", "Score (1 is at the limit)", 2, icon="mdi:gauge"),
        }
        if self._can_acknowledge:
            entities[ACKNOWLEDGE] = entity(
                ACKNOWLEDGE,
                "button",
                "Acknowledge",
                command_topic=self._topics.request(fan.tray, fan.number),
                payload_press=text_of({"action": ACKNOWLEDGE, "comment": "from Home Assistant"}),
                icon="mdi:check",
            )
        about = {"name": f"{fan.tray} fan {fan.number}", "model": "fan", "via_device": self._identifier(SITE_DEVICE)}
        return self._device(name, about, entities)

    def _device(self, name: str, about: dict[str, Any], entities: dict[str, Any]) -> dict[str, Any]:
        return {
            "device": {"identifiers": [self._identifier(name)], "manufacturer": "fantwin", **about},
            "origin": {"name": "fantwin", "sw_version": version("fantwin")},
            "components": entities,
            "qos": _QOS,
        }

    def _of_site(self, key: str, platform: str, name: str) -> dict[str, Any]:
        return {"platform": platform, "unique_id": f"{self._node}-{SITE_DEVICE}-{key}", "name": name}

    def _availability(self) -> dict[str, Any]:
        return {
            "availability_topic": self._topics.status,
            "payload_available": ONLINE,
            "payload_not_available": OFFLINE,
        }

    def _identifier(self, name: str) -> str:
        return f"{self._node}-{name}"
