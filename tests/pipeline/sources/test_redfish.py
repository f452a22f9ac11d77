"""Fans by Redfish, against a real HTTP server with the older and the newer schema."""

from __future__ import annotations

import math
import ssl
from pathlib import Path
from typing import Any

import pytest
import trustme

from fantwin.pipeline.cli.watch.line_check import check_line
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.runtime.stage import Context
from fantwin.pipeline.sources.polling import DeviceError
from fantwin.pipeline.sources.redfish.config import RedfishConfig
from fantwin.pipeline.sources.redfish.source import RedfishSource
from fantwin.pipeline.sources.source import Reading, Rejected, SourceContext
from fantwin.schemas.channels import TEMPERATURE
from tests.support.redfish_server import Controller, redfish_server

SECRET = "correct-horse"


def device(url: str, count: int = 2, folder: Path = Path(), **settings: Any) -> RedfishSource:
    config = RedfishConfig.model_validate({"url": url, **settings})
    return RedfishSource(config, SourceContext(count, "rpm", folder))


def connected(url: str, count: int = 2, folder: Path = Path(), **settings: Any) -> RedfishSource:
    made = device(url, count, folder, **settings)
    made.connect()
    return made


def reading(made: RedfishSource) -> Reading:
    found = made.read()
    assert isinstance(found, Reading)
    return found


def test_the_newer_schema_gives_speed_and_percent() -> None:
    controller = Controller(is_new=True)
    with redfish_server(controller) as url:
        made = connected(url, temperature="Intake")
        assert reading(made) == Reading((40.0, 42.0), (4000.0, 4200.0), measured={TEMPERATURE: (22.0, 22.0)})
        assert made.fans_called == (("FAN1", "Fan bay 1"), ("FAN2", "Intake"))
        controller.rpm[1], controller.percent[1] = 0, 100
        assert reading(made).speed == (4000.0, 0.0)
        chosen = connected(f"{url}/redfish/v1/Chassis/1U", 1, fans=["FAN2"])
        assert reading(chosen).command == (100.0,)
        made.disconnect()
        chosen.disconnect()


def test_doctor_says_what_to_write_for_the_names_and_places_that_the_controller_gives(tmp_path: Path) -> None:
    tray = '[[tray]]\nname = "bmc"\nspeed_unit = "rpm"\ncommand_max = 100\n'
    with redfish_server(Controller(is_new=True)) as url:

        def said(fans: str) -> list[str]:
            source = f'source = {{ kind = "redfish", url = "{url}" }}'
            config = parse_config(f"{tray}{fans}\n{source}\n", tmp_path / "site.toml", stages=("acquisition",))
            context = Context("site", config.trays, config.sections["acquisition"], tmp_path, tmp_path, 0)
            return [line for _, line in check_line(context, config, 0.5, is_running=False)]

        named = 'fan = [{ name = "FAN1", place = "Fan bay 1" }, { name = "FAN2", place = "Intake" }]'
        assert f"bmc: its device names the fans: to show these, write {named}" in said("fans = 2")
        assert not any("names the fans" in line for line in said(named))


def test_the_older_schema_gives_speeds_and_the_command_of_the_vendor() -> None:
    controller = Controller(is_new=False)
    with redfish_server(controller) as url:
        made = connected(url, command="/Oem/Vendor/PWM", temperature="Inlet Temp")
        assert reading(made) == Reading((40.0, 42.0), (4000.0, 4200.0), measured={TEMPERATURE: (23.5, 23.5)})
        unknown = connected(url)
        refused = unknown.read()
        assert isinstance(refused, Rejected) and refused.kind == "unknown_command" and refused.is_sample
        assert "no fan has a number at /SpeedPercent/Reading" in refused.detail
        unread = connected(url, 1, fans=["FAN1"], command="/Oem/Vendor/PWM", temperature="Exhaust")
        assert math.isnan(reading(unread).measured[TEMPERATURE][0])


def test_what_does_not_fit_the_controller_is_one_line() -> None:
    with redfish_server(Controller(is_new=True)) as url:
        with pytest.raises(DeviceError, match=r"^no fan 'FAN9'; there are: FAN1, 1, FAN2, 2"):
            connected(url, fans=["FAN9", "FAN1"]).read()
        with pytest.raises(DeviceError, match="^2 fans, this tray has 3"):
            connected(url, 3).read()
        with pytest.raises(
            DeviceError, match="^chassis with fans: /redfish/v1/Chassis/1U; let source.url end with the path of one"
        ):
            connected(f"{url}/redfish/v1/Chassis/Rack")


def test_a_controller_that_fails_or_is_slow_is_a_failed_poll_and_one_that_is_gone_is_lost(monkeypatch) -> None:
    controller = Controller(is_new=True)
    with redfish_server(controller) as url:
        made = connected(url)
        controller.status = 503
        with pytest.raises(DeviceError, match="^refused with HTTP status 503") as caught:
            made.read()
        assert not caught.value.is_lost
        controller.status = 200
        made.disconnect()
        monkeypatch.setattr("fantwin.pipeline.sources.redfish.source.TIMEOUT_S", 2.0)
        made = connected(url)
        controller.may_answer.clear()
        with pytest.raises(DeviceError, match="^does not answer within 2 s") as caught:
            made.read()
        controller.may_answer.set()
        made.disconnect()
    with pytest.raises(DeviceError, match="cannot be reached; waiting for it") as caught:
        connected(url)
    assert caught.value.is_lost


def test_a_password_comes_from_a_file_of_its_owner_and_goes_over_a_verified_line_only(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    authority = trustme.CA()
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert("127.0.0.1").configure_cert(tls)
    authority.cert_pem.write_to_path(str(tmp_path / "ca.pem"))
    file = tmp_path / "bmc.secret"
    file.write_text(f"{SECRET}\n")
    controller = Controller(is_new=True, user="operator", password=SECRET)
    with redfish_server(controller, tls) as address:
        url = address.replace("//", "//operator@")
        settings = {"folder": tmp_path, "verify": "ca.pem", "password_file": "bmc.secret"}
        with pytest.raises(UserError, match="others may read it: chmod 600"):
            connected(url, **settings)
        assert "others may read it" in device(url, **settings).check()[0]
        file.chmod(0o600)
        made = connected(url, **settings)
        assert reading(made).speed == (4000.0, 4200.0)
        made.disconnect()
        with pytest.raises(
            DeviceError, match="^its certificate cannot be verified: name the authority by source.verify"
        ):
            connected(url, folder=tmp_path, password_file="bmc.secret")
        file.write_text(f"{SECRET}-not\n")
        with pytest.raises(DeviceError, match="^user or password is refused") as caught:
            connected(url, **settings)
        assert SECRET not in str(caught.value)
    with pytest.raises(DeviceError, match="would send the password in the clear"):
        connected("http://operator@127.0.0.1:9", folder=tmp_path, password_file="bmc.secret")
    assert SECRET not in caplog.text
