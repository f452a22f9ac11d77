"""Settings that would open an output to others, or that cannot work, are refused: those that concern several keys.

What is wrong with one key: tests/pipeline/cli/refusals.txt.
"""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import BaseModel

from fantwin.pipeline.outputs.mqtt.config import MqttConfig
from fantwin.pipeline.outputs.opcua.config import OpcuaConfig
from fantwin.pipeline.outputs.web.config import GatewayConfig


@pytest.mark.parametrize(
    ("model", "settings", "why"),
    [
        (GatewayConfig, {"host": "0.0.0.0"}, "needs certificate and key"),
        (GatewayConfig, {"host": "0.0.0.0", "certificate": "c.pem", "key": "k.pem"}, "needs users"),
        (GatewayConfig, {"host": "0.0.0.0", "in_front": "tls"}, "needs users"),
        (GatewayConfig, {"certificate": "c.pem"}, "belong together"),
        (GatewayConfig, {"operators": ("ann",)}, "user_header"),
        (OpcuaConfig, {"host": "0.0.0.0"}, "needs users"),
        (OpcuaConfig, {"certificate": "c.pem"}, "belong together"),
        (MqttConfig, {"url": "mqtt://broker "}, "such as mqtts://HOST"),
        (MqttConfig, {"password_file": "x"}, "needs a user in url, such as mqtt://USER@broker"),
        (MqttConfig, {"ca": "x"}, "need mqtts://"),
    ],
)
def test_settings_that_open_an_output_or_cannot_work_are_refused(
    model: type[BaseModel], settings: dict[str, Any], why: str
) -> None:
    with pytest.raises(ValueError, match=why):
        model.model_validate(({"url": "mqtt://broker"} if model is MqttConfig else {}) | settings)
