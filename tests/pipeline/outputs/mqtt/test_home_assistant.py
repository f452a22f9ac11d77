"""Discovery payloads against what Home Assistant's documentation and schemas (2024.11 to 2026.11) accept."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from jinja2 import Environment

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.mqtt.config import MqttConfig
from fantwin.pipeline.outputs.mqtt.home_assistant import HomeAssistant
from fantwin.pipeline.outputs.mqtt.topics import Topics
from fantwin.pipeline.site.fleet import FanGroup

TRAYS = (TrayConfig(name="tray1", fans=2, speed_unit="rpm"), TrayConfig(name="tray-2", fans=3, speed_unit="rad/s"))
TOPIC = re.compile(r"homeassistant/device/([a-zA-Z0-9_-]+)/([a-zA-Z0-9_-]+)/config")
"""as Home Assistant matches it"""
DEVICE_KEYS = {
    *("identifiers", "connections", "manufacturer", "model", "model_id", "name", "hw_version", "serial_number"),
    *("sw_version", "via_device", "suggested_area", "configuration_url"),
}
ENTITY_KEYS = {
    *("platform", "unique_id", "name", "icon", "entity_category", "entity_picture", "enabled_by_default", "qos"),
    *("encoding", "default_entity_id", "json_attributes_topic", "json_attributes_template", "availability"),
    *("availability_mode", "availability_topic", "availability_template", "payload_available", "device_class"),
    *("payload_not_available",),
}
STATE_KEYS = {"state_topic", "value_template", "expire_after", "force_update"}
KEYS = {
    "binary_sensor": ENTITY_KEYS | STATE_KEYS | {"off_delay", "payload_on", "payload_off"},
    "sensor": ENTITY_KEYS
    | STATE_KEYS
    | {"options", "last_reset_value_template", "suggested_display_precision", "state_class", "unit_of_measurement"},
    "button": ENTITY_KEYS | {"command_topic", "command_template", "payload_press", "retain"},
}
REQUIRED = {"binary_sensor": "state_topic", "sensor": "state_topic", "button": "command_topic"}


def devices_of(topics: Topics | None = None, **settings: Any) -> dict[str, dict[str, Any]]:
    """The devices by the last part of their topics."""
    config = MqttConfig.model_validate(
        {"url": "mqtt://broker", "home_assistant": [tray.name for tray in TRAYS]} | settings
    )
    messages = HomeAssistant(config, topics or Topics("hall"), TRAYS).messages()
    found: dict[str, dict[str, Any]] = {}
    for topic, text in messages.items():
        match = TOPIC.fullmatch(topic)
        assert match, topic
        found[match[2]] = json.loads(text)
    return found


@pytest.mark.parametrize("settings", [{}, {"accept": ("acknowledge",)}])
def test_payloads_have_the_documented_keys_and_all_that_are_required(settings):
    devices = devices_of(**settings)
    assert devices.keys() == {"site", "tray1-0", "tray1-1", "tray-2-0", "tray-2-1", "tray-2-2"}
    identifiers, unique_ids = list[str](), list[str]()
    for device in devices.values():
        assert device.keys() <= {"device", "origin", "components", "availability", "state_topic", "qos", "encoding"}
        assert device["device"].keys() <= DEVICE_KEYS
        assert device["origin"].keys() <= {"name", "sw_version", "support_url"}
        assert device["origin"]["name"] == "fantwin"
        identifiers += device["device"]["identifiers"]
        for entity in device["components"].values():
            platform = entity["platform"]
            assert entity.keys() <= KEYS[platform], entity.keys() - KEYS[platform]
            assert entity[REQUIRED[platform]].startswith("fantwin/hall/")
            unique_ids.append(entity["unique_id"])
    assert len(set(identifiers)) == len(identifiers) == len(devices)
    assert len(set(unique_ids)) == len(unique_ids)
    assert all(
        device["device"].get("via_device", devices["site"]["device"]["identifiers"][0]) in identifiers
        for device in devices.values()
    )


def test_entities_have_a_unit_and_are_unavailable_when_the_stage_is_gone_but_for_the_one_that_says_so():
    fan = devices_of()["tray-2-1"]["components"]
    assert (fan["speed"]["unit_of_measurement"], fan["problem"]["device_class"]) == ("rad/s", "problem")
    for entity in fan.values():
        assert entity["availability_topic"] == "fantwin/hall/status"
        assert (entity["payload_available"], entity["payload_not_available"]) == ("online", "offline")
    assert "availability_topic" not in devices_of()["site"]["components"]["running"]


def test_the_state_is_one_of_the_groups_what_few_need_is_diagnostic_and_each_device_leads_to_the_page():
    fan = devices_of()["tray-2-1"]["components"]
    assert (fan["state"]["device_class"], fan["state"]["options"]) == (
        "enum",
        ["alarm", "suspect", "not judged", "silenced", "at rest", "normal"],
    )
    template = Environment().from_string(fan["state"]["value_template"])
    shown = {template.render(value_json={"group": str(group)}) for group in FanGroup}
    assert shown == set(fan["state"]["options"]), "Home Assistant refuses any other"
    diagnostic = {name for name, entity in fan.items() if entity.get("entity_category") == "diagnostic"}
    assert diagnostic == {"score", "predicted_speed"}
    (config, topics) = MqttConfig(url="mqtt://broker", home_assistant=("tray-2",)), Topics("hall")
    texts = HomeAssistant(config, topics, TRAYS, "https://fans.plant.example/").messages().values()
    assert {json.loads(each)["device"]["configuration_url"] for each in texts} == {"https://fans.plant.example/"}
    assert "configuration_url" not in devices_of()["site"]["device"], "without a page there is no link"


def test_only_the_fans_of_named_trays_are_devices():
    assert devices_of(home_assistant=("tray-2",)).keys() == {"site", "tray-2-0", "tray-2-1", "tray-2-2"}


def test_a_button_acknowledges_where_that_is_accepted():
    button = devices_of(accept=("acknowledge",))["tray1-0"]["components"]["acknowledge"]
    assert button["command_topic"] == "fantwin/hall/tray1/0/request"
    assert json.loads(button["payload_press"])["action"] == "acknowledge"
    assert "acknowledge" not in devices_of(accept=("shelve",))["tray1-0"]["components"]


def test_sites_and_shards_have_devices_of_their_own():
    def identifier(topics: Topics) -> str:
        return devices_of(topics)["site"]["device"]["identifiers"][0]

    assert identifier(Topics("hall")) == "fantwin_hall-site"
    assert identifier(Topics("hall", "2-of-4")) == "fantwin_hall_2-of-4-site"
