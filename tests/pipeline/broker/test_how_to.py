"""docs/how-to/mqtt.md: each configuration that it shows is one, and what it says of defaults is so."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from pydantic import ValidationError

from pipeline.broker.config import MqttConfig

PAGE = (Path(__file__).parents[3] / "docs" / "how-to" / "mqtt.md").read_text(encoding="utf-8")


def test_each_configuration_of_the_page_is_one():
    found = [tomllib.loads(text)["mqtt"] for text in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)]
    assert len(found) == 3
    for section in found:
        MqttConfig.model_validate(section)


def test_by_default_nothing_is_accepted_and_home_assistant_knows_nothing():
    config = MqttConfig.model_validate({"host": "broker"})
    assert (config.prefix, config.period_s, config.most_waiting) == ("fantwin", 5.0, 10_000)
    assert (config.accept, config.home_assistant, config.home_assistant_fans) == ((), "off", 64)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"accept": ["acknowledge"]}, "belong together"),
        ({"operator_name": "desk"}, "belong together"),
        ({"accept": ["explode"], "operator_name": "desk"}, "accept"),
        ({"prefix": "a/#"}, "prefix"),
        ({"prefix": "$SYS"}, "prefix"),
        ({"prefix": "a/"}, "prefix"),
        ({"password_env": "X"}, "a password needs username"),
        ({"ca": "x"}, "need tls = true"),
        ({"topic": "x"}, "topic"),
    ],
)
def test_settings_that_do_not_fit_are_refused(settings, words):
    with pytest.raises(ValidationError, match=words):
        MqttConfig.model_validate({"host": "broker", **settings})
