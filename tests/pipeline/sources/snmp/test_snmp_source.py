"""Fans by SNMP, against a real agent on loopback."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.kinds import build_source
from fantwin.pipeline.sources.polling import DeviceError
from fantwin.pipeline.sources.snmp import source as module
from fantwin.pipeline.sources.snmp.config import SnmpConfig
from fantwin.pipeline.sources.snmp.source import SnmpSource
from fantwin.pipeline.sources.source import Reading, SourceContext
from fantwin.schemas.channels import TEMPERATURE
from tests.support.fantwin_command import error_of, fantwin
from tests.support.ports import free_port
from tests.support.snmp_agent import COMMUNITY, PASSWORD, PRIVACY, USER, Agent, snmp_agent

SENSOR = "1.3.6.1.2.1.99.1.1.1.4"
"""entPhySensorValue"""
OUTPUT, AIR = "1.3.6.1.4.1.2606.7.4.2.2.1.11.2", "1.3.6.1.4.1.2606.7.4.2.2.1.11.3"
FANS: list[dict[str, Any]] = [
    {
        "speed": f"{SENSOR}.{n}",
        "command": {"name": OUTPUT, "scale": 0.1},
        "temperature": {"name": AIR, "offset": -273},
    }
    for n in range(1, 41)
]


@pytest.fixture
def agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Agent]:
    monkeypatch.setattr(module, "TIMEOUT_S", 0.2)
    for name, secret in {"v2": COMMUNITY, "v3": PASSWORD, "key": PRIVACY, "wrong": "wrong-horse-battery"}.items():
        (tmp_path / name).write_text(f"{secret}\n")
        (tmp_path / name).chmod(0o600)
    agent = Agent()
    agent.objects |= {f"{SENSOR}.{n}": 3000 + n for n in range(1, 41)} | {OUTPUT: 405, AIR: 296}
    agent.port = free_port()
    with snmp_agent(agent, agent.port):
        yield agent


def reading(agent: Agent, folder: Path, **settings: Any) -> Reading:
    config = SnmpConfig.model_validate({"host": f"127.0.0.1:{agent.port}", "fan": FANS, **settings})
    source = SnmpSource(config, SourceContext(len(config.fan), "rpm", folder))
    try:
        source.connect()
        return source.read()
    finally:
        source.disconnect()


V2 = {"community_file": "v2"}
V3 = {"user": USER, "password_file": "v3", "privacy_file": "key"}


@pytest.mark.parametrize("log_in", [V2, V3], ids=["2c", "3"])
def test_forty_fans_are_read_with_scale_and_offset(log_in: dict[str, str], agent: Agent, tmp_path: Path) -> None:
    found = reading(agent, tmp_path, **log_in)
    assert found.speed == tuple(float(3000 + n) for n in range(1, 41))
    assert found.command == pytest.approx((40.5,) * 40) and found.measured == {TEMPERATURE: (23.0,) * 40}


def test_an_object_that_is_not_there_or_no_number_costs_its_fan(agent: Agent, tmp_path: Path) -> None:
    agent.objects |= {f"{SENSOR}.1": "2100 RPM", f"{SENSOR}.2": "fan 3", f"{SENSOR}.3": 0, f"{SENSOR}.4": "12"}
    del agent.objects[f"{SENSOR}.5"]
    assert json.dumps(reading(agent, tmp_path, **V2).speed[:6]) == "[2100.0, NaN, 0.0, 12.0, NaN, 3006.0]"
    agent.objects = {OUTPUT: 405}
    with pytest.raises(DeviceError, match=rf"no number at {SENSOR}.1 and the other speeds: snmpwalk shows") as caught:
        reading(agent, tmp_path, **V2)
    assert not caught.value.is_lost


@pytest.mark.parametrize(
    ("log_in", "why"),
    [
        ({"community_file": "wrong"}, "No SNMP response received before timeout: check source.host and its community"),
        ({**V3, "password_file": "wrong"}, "Wrong SNMP PDU digest: check source.host and its user and passwords"),
        ({**V3, "user": "bob"}, "Unknown USM user: check source.host and its user and passwords"),
        ({**V2, "host": "no-such-host.invalid"}, "its address is not known here: check source.host"),
    ],
)
def test_why_an_agent_cannot_be_read_is_one_line_without_secrets(
    log_in: dict[str, str], why: str, agent: Agent, tmp_path: Path
) -> None:
    with pytest.raises(DeviceError) as caught:
        reading(agent, tmp_path, **log_in)
    assert str(caught.value) == f"{why}; waiting for it" and "\n" not in str(caught.value)


def test_secrets_are_in_files_of_their_owner_and_one_log_in_is_given(agent: Agent, tmp_path: Path) -> None:
    (tmp_path / "v2").chmod(0o644)
    with pytest.raises(UserError, match="v2: others may read it: chmod 600"):
        reading(agent, tmp_path, **V2)
    for settings in ({}, {**V2, **V3}, {"user": USER}):
        with pytest.raises(ValueError, match=r"give community_file \(version 2c\), or user and password_file"):
            SnmpConfig.model_validate({"host": "switch7", "fan": FANS, **settings})
    with pytest.raises(ValueError, match="give a name or an address"):
        SnmpConfig.model_validate({"host": "udp://switch7", "fan": FANS, **V2})
    with pytest.raises(ValueError, match="'sysDescr.0' is no identifier with numbers: snmptranslate -On"):
        SnmpConfig.model_validate({"host": "switch7", "fan": [{"speed": "sysDescr.0"}], **V2})


def entity(index: int, value: int, name: str, *, kind: int = 10, scale: int = 9, precision: int = 0, unit: str = ""):
    """Objects of a sensor, as in RFC 3433."""
    table = {1: kind, 2: scale, 3: precision, 4: value, 6: unit}
    found = {f"1.3.6.1.2.1.99.1.1.1.{column}.{index}": each for column, each in table.items() if each != ""}
    return {**found, f"1.3.6.1.2.1.47.1.1.1.1.7.{index}": name}


def test_init_says_of_a_table_without_end_or_of_a_scale_that_is_none_what_it_is(
    agent: Agent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("init", "--snmp", f"127.0.0.1:{agent.port}", "--password-file", "v2")
    agent.objects = entity(1001, 5100, "Tray 1 fan", precision=-(2**31))
    assert "Tray 1 fan has scale '9', precision '-2147483648': name objects" in error_of(*words)
    monkeypatch.setattr(module, "MOST_ROWS", 30)
    for index in range(1, 101):
        agent.objects |= entity(index, 5100, f"Fan {index}")
    assert "a table of more than 30 rows: name objects by source.fan" in error_of(*words)


def test_init_finds_the_sensors_in_rpm_with_their_scales_and_none_that_is_in_per_cent(
    agent: Agent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("init", "--snmp", f"127.0.0.1:{agent.port}", "--password-file", "v2")
    agent.objects = entity(7, 41, "CPU", kind=8) | entity(10, 39, "Fan1", precision=1, unit="Percent (%)")
    none = error_of(*words)
    assert none.endswith("1 say that they are in rpm, and show Percent (%); name objects by source.fan")
    agent.objects |= entity(1001, 5100, "Tray 1 fan") | entity(1002, 52000, "Tray 2 fan", precision=1)
    agent.objects |= entity(1003, 5300, "Tray 3 fan", scale=8, precision=0)
    assert fantwin(*words).exit_code == 0
    (tray,) = load_config(tmp_path / "fantwin.toml", stages=()).trays
    assert tray.names.names == ("Tray 1 fan", "Tray 2 fan", "Tray 3 fan")
    source = build_source(tray.source, SourceContext(3, "rpm", tmp_path))
    assert isinstance(source, SnmpSource)
    source.connect()
    assert source.read().speed == pytest.approx((5100.0, 5200.0, 5.3))
    source.disconnect()
    agent.objects = {}
    assert "no fans in rpm in its ENTITY-SENSOR-MIB; name" in error_of(*words, "-c", "x.toml")
    assert "give --password-file, a file with the community" in error_of("init", "--snmp", "switch7", "-c", "x.toml")
