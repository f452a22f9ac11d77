"""Settings that would open an output to others, or that cannot work, are refused: one table for all outputs."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import BaseModel

from fantwin.pipeline.outputs.mqtt.config import MqttConfig
from fantwin.pipeline.outputs.notify.config import NotifierConfig
from fantwin.pipeline.outputs.opcua.config import OpcuaConfig
from fantwin.pipeline.outputs.web.config import GatewayConfig

MAIL: dict[str, Any] = {"name": "mail", "url_file": "mail.url"}


@pytest.mark.parametrize(
    ("model", "settings", "why"),
    [
        (GatewayConfig, {"host": "0.0.0.0"}, "needs certificate and key"),
        (GatewayConfig, {"host": "0.0.0.0", "certificate": "c.pem", "key": "k.pem"}, "needs users"),
        (GatewayConfig, {"certificate": "c.pem"}, "belong together"),
        (GatewayConfig, {"operators": ("ann",)}, "user_header"),
        (GatewayConfig, {"user_header": "X-User", "proxies": ("proxy.plant.example",)}, "address of the proxy"),
        (OpcuaConfig, {"host": "0.0.0.0"}, "needs users"),
        (OpcuaConfig, {"certificate": "c.pem"}, "belong together"),
        (MqttConfig, {"accept": ["explode"]}, "accept"),
        *(
            (MqttConfig, {"url": url}, "such as mqtts://HOST")
            for url in (
                "broker:1883",
                "mqtt://u:1/2@broker",
                "mqtt://u#p@broker",
                "mqtt://broker/topic",
                "mqtt://broker ",
            )
        ),
        (MqttConfig, {"url": "mqtt://u:p@broker"}, "give password_file, and only the user"),
        (MqttConfig, {"password_file": "x"}, "needs a user in url, such as mqtt://USER@broker"),
        (MqttConfig, {"ca": "x"}, "need mqtts://"),
        (NotifierConfig, {"target": [{"name": "a"}]}, "url"),
        (NotifierConfig, {"target": [{"name": "a", "url": "mailto://u:p@h"}]}, "url"),
        (NotifierConfig, {"target": [MAIL | {"kind": "alertmanager", "repeat_s": 60}]}, "take out repeat_s"),
        (NotifierConfig, {"target": [MAIL | {"quiet_hours": "25:00-22:00"}]}, "22:00-06:00"),
        (NotifierConfig, {"target": [MAIL | {"quiet_hours": "22:00-22:00"}]}, "22:00-06:00"),
        (NotifierConfig, {"target": [MAIL, MAIL]}, "two targets"),
    ],
)
def test_settings_that_open_an_output_or_cannot_work_are_refused(
    model: type[BaseModel], settings: dict[str, Any], why: str
) -> None:
    with pytest.raises(ValueError, match=why):
        model.model_validate(({"url": "mqtt://broker"} if model is MqttConfig else {}) | settings)
