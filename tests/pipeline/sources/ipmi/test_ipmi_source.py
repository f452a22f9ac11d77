"""Fans by IPMI, from what ipmitool prints for the controllers of several makers."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.ipmi import source as module
from fantwin.pipeline.sources.ipmi.config import IpmiConfig
from fantwin.pipeline.sources.ipmi.source import IpmiSource
from fantwin.pipeline.sources.kinds import build_source
from fantwin.pipeline.sources.polling import DeviceError
from fantwin.pipeline.sources.source import Reading, SourceContext
from fantwin.schemas.channels import TEMPERATURE
from tests.support.fantwin_command import error_of, fantwin

SUPERMICRO = """\
FAN1             | 41h | ok  | 29.1 | 3400 RPM
FAN2             | 42h | cr  | 29.2 | 0 RPM
FAN3             | 43h | ns  | 29.3 | No Reading
FANA             | 45h | ok  | 29.5 | 3500 RPM
"""
DELL = """\
Fan1 RPM         | 30h | ok  |  7.1 | 2160 RPM
Fan2 RPM         | 31h | ok  |  7.1 | 2040 RPM
Fan Redundancy   | 75h | ok  |  7.1 | Fully Redundant
"""
HPE = """\
Fan 1            | 0Ah | ok  |  7.1 | 39.20 percent
Fan 2            | 0Bh | ns  |  7.2 | Disabled
Fans             | 10h | ok  |  7.1 | Redundant
"""
OPENBMC = """\
FAN0_TACH        | 60h | ok  | 29.1 | 7154 RPM
FAN0_PWM         | 70h | ok  | 29.1 | 40.78 percent
"""
REPEATED = """\
Fan              | 01h | ok  |  7.1 | 1000 RPM
Fan              | 02h | ok  |  7.2 | 2000 RPM
"""
TEMPERATURE_OF_AIR = "Inlet Temp       | 05h | ok  |  7.1 | 23 degrees C\n"
Made = Callable[..., IpmiSource]


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Made:
    """Makes a source of what a program prints in the place of ipmitool; its words are in the file `words`."""

    def make(text: str, fans: list[Any], script: str = "", **settings: Any) -> IpmiSource:
        (tmp_path / "Fan").write_text(text)
        (tmp_path / "Temperature").write_text(TEMPERATURE_OF_AIR)
        program = tmp_path / "ipmitool"
        names = f'cd {tmp_path}; printf \'%s\\n\' "$@" >> words; for last; do :; done; [ -f "$last" ] && cat "$last"'
        program.write_text(f"#!/bin/sh\n{script or names}\nexit 0\n")
        program.chmod(0o755)
        monkeypatch.setattr(module, "PROGRAM", str(program))
        rows = [{"speed": fan} if isinstance(fan, str) else fan for fan in fans]
        config = IpmiConfig.model_validate({"fan": rows, **settings})
        return IpmiSource(config, SourceContext(len(fans), "rpm", tmp_path))

    return make


def reading(source: IpmiSource) -> Reading:
    source.connect()
    found = source.read()
    source.disconnect()
    return found


DELL_FANS = ["Fan1 RPM", "31h"]


def test_only_rpm_is_a_speed_only_per_cent_a_command_and_no_reading_is_no_zero(made: Made) -> None:
    chosen = made(SUPERMICRO, ["FAN1", "FAN2", "FAN3", "45h"])
    assert json.dumps(reading(chosen).speed) == "[3400.0, 0.0, NaN, 3500.0]"
    dell = reading(made(DELL, DELL_FANS))
    assert dell.speed == (2160.0, 2040.0) and all(map(math.isnan, dell.command))
    openbmc = made(OPENBMC, [{"speed": "FAN0_TACH", "command": "FAN0_PWM", "temperature": "Inlet Temp"}])
    assert reading(openbmc) == Reading((40.78,), (7154.0,), measured={TEMPERATURE: (23.0,)})
    assert reading(made(REPEATED, ["01h", "02h"])).speed == (1000.0, 2000.0)


def test_a_fan_that_loses_its_reading_later_costs_itself_alone(made: Made, tmp_path: Path) -> None:
    source = made(DELL, DELL_FANS)
    source.connect()
    (tmp_path / "Fan").write_text(DELL.replace("2040 RPM", "No Reading"))
    assert json.dumps(source.read().speed) == "[2160.0, NaN]"


@pytest.mark.parametrize(
    ("text", "fan", "why"),
    [
        (HPE, "Fan 1", "sensor 'Fan 1' is in percent, not in RPM: correct source.fan"),
        (HPE, "Fan 2", "no number at Fan 2: correct source.fan"),
        (REPEATED, "Fan", "several sensors 'Fan': Fan (01h), Fan (02h); write the id of one"),
        (OPENBMC, "FAN9", "no sensor 'FAN9': FAN0_TACH (60h), FAN0_PWM (70h); write the id of one"),
        (OPENBMC, {"speed": "60h", "command": "60h"}, "sensor '60h' is in RPM, not in percent: correct source.fan"),
        ("", "Fan", "no sensor 'Fan': none; write the id of one"),
    ],
)
def test_what_does_not_fit_the_controller_is_one_line(made: Made, text: str, fan: Any, why: str) -> None:
    with pytest.raises(DeviceError) as caught:
        reading(made(text, [fan]))
    assert str(caught.value) == why


def test_the_password_is_in_no_command_line_and_sensors_are_described_once(made: Made, tmp_path: Path) -> None:
    (tmp_path / "bmc.secret").write_text("correct-horse\n")
    settings = {"url": "ipmi://ann@bmc7:1623", "password_file": "bmc.secret", "cipher": 17}
    source = made(DELL, DELL_FANS, **settings)
    assert "others may read it: chmod 600" in source.check()[0]
    with pytest.raises(UserError, match="others may read it: chmod 600"):
        source.connect()
    (tmp_path / "bmc.secret").chmod(0o600)
    source.connect()
    source.read()
    source.disconnect()
    words = (tmp_path / "words").read_text()
    assert "correct-horse" not in words
    log_in = ["-H", "bmc7", "-p", "1623", "-U", "ann", "-N", "1", "-R", "2", "-f", str(tmp_path / "bmc.secret")]
    assert " ".join([*log_in, "-L", "USER", "-C", "17"]) in " ".join(words.splitlines())
    assert words.count("\ndump\n") == 1 and words.count("\ntype\n") == 1


def test_what_keeps_ipmitool_from_reading_says_what_to_do(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = "echo 'Could not open device at /dev/ipmi0 or /dev/ipmi/0: No such file or directory' >&2; exit 1"
    with pytest.raises(DeviceError, match=r"/dev/ipmi0 .*; load the driver \(modprobe ipmi_devintf ipmi_si\), run as"):
        reading(made(DELL, DELL_FANS, driver))
    refused = "echo 'IANA PEN registry open failed' >&2; echo 'Error: Unable to establish IPMI v2 / RMCP+ session' >&2"
    with pytest.raises(DeviceError, match=r"Unable to establish IPMI v2 / RMCP\+ session; check source.url, user") as e:
        reading(made(DELL, DELL_FANS, f"{refused}; exit 1"))
    assert e.value.is_lost
    source = made(DELL, DELL_FANS, "sleep 30")
    monkeypatch.setattr(module, "TIMEOUT_S", 0.02)
    with pytest.raises(DeviceError, match=r"does not answer within 0.2 s; waiting for it"):
        source.connect()
    monkeypatch.setattr(module, "PROGRAM", "no-such-ipmitool")
    assert source.check() == ["source ipmi needs the program ipmitool: install the package ipmitool of the system"]


def test_init_writes_a_tray_of_the_fans_in_rpm_and_names_what_may_be_their_command(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret").write_text("correct-horse\n")
    (tmp_path / "secret").chmod(0o600)
    made(SUPERMICRO + OPENBMC, ["FAN1"])
    done = fantwin("init", "--ipmi", "ipmi://ann@bmc[8-11]", "--password-file", "secret")
    assert done.exit_code == 0, done.output
    assert "name a sensor in per cent by command of source.fan (FAN0_PWM)" in done.stdout
    text = Path("fantwin.toml").read_text()
    assert text.count("[[tray]]") == 1 and 'hosts = ["bmc[8-11]"]' in text
    trays = load_config(tmp_path / "fantwin.toml", stages=()).trays
    assert [tray.name for tray in trays] == ["bmc8", "bmc9", "bmc10", "bmc11"]
    assert trays[3].names.names == ("FAN1", "FAN2", "FANA", "FAN0_TACH")
    source = build_source(trays[3].source, SourceContext(4, "rpm", tmp_path))
    assert isinstance(source, IpmiSource) and reading(source).speed == (3400.0, 0.0, 3500.0, 7154.0)
    made(REPEATED, ["01h"])
    assert fantwin("init", "--ipmi", "ipmi://localhost", "-c", "own.toml").exit_code == 0
    (own,) = load_config(tmp_path / "own.toml", stages=()).trays
    assert (own.fans, [fan.speed.name for fan in own.source.fan]) == (2, ["01h", "02h"])  # type: ignore[attr-defined]
    made(HPE, ["Fan 1"])
    none = "no fans in rpm; its sensors of fans: Fan 1 (percent), Fan 2 (no number), Fans (no number)"
    assert error_of("init", "--ipmi", "ipmi://localhost", "-c", "x.toml") == f"ipmi://localhost: {none}"
    assert "needs a user in url" in error_of("init", "--ipmi", "ipmi://bmc7", "-c", "x.toml")


def test_a_controller_in_the_network_needs_a_user_and_a_password() -> None:
    for settings in ({"url": "ipmi://bmc7"}, {"url": "ipmi://ann@bmc7"}):
        with pytest.raises(ValueError, match="needs a user in url, ipmi://USER@HOST, and password_file"):
            IpmiConfig.model_validate({"fan": [{"speed": "FAN1"}], **settings})
