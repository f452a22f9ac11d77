"""Fans by Redfish, against a real HTTP server with the older and the newer schema."""

from __future__ import annotations

import math
import re
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
from tests.support.redfish_server import (
    CHASSIS,
    ROOT,
    Answer,
    Controller,
    Documents,
    link,
    redfish_server,
    with_fans,
    with_thermal,
)

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
        said = "no command is known: say where by source.command; FAN1 has Reading 4000, Oem/Vendor/PWM 40"
        assert refused.detail.startswith(said)
        unread = connected(url, 1, fans=["FAN1"], command="/Oem/Vendor/PWM", temperature="Exhaust")
        assert math.isnan(reading(unread).measured[TEMPERATURE][0])


SUBSYSTEM = f"{CHASSIS}/ThermalSubsystem"
SENSORS = f"{CHASSIS}/Sensors"
ON, OFF = {"State": "Enabled"}, {"State": "StandbyOffline"}
DUTY = {"Oem": {"Duty": 40}}
NOTHING = math.nan


def with_sensors(documents: dict[str, Answer], **readings: tuple[Any, str]) -> dict[str, Answer]:
    """The documents with sensors of the chassis: reading and unit of each."""
    chassis = documents[CHASSIS]
    assert isinstance(chassis, dict)
    found = {
        f"{SENSORS}/{name}": {"Id": name, "Name": name.replace("_", " "), "Reading": value, "ReadingUnits": unit}
        for name, (value, unit) in readings.items()
    }
    return {
        **documents,
        CHASSIS: {**chassis, "Sensors": link(SENSORS)},
        SENSORS: {"Members": list(map(link, found))},
        **found,
    }


def thermal_and_subsystem() -> dict[str, Answer]:
    """OpenBMC with both schemas, of which the newer has no speeds."""
    old = with_thermal(*({"Name": f"fan{n}_0", "Reading": 5000 + n, "ReadingUnits": "RPM", **DUTY} for n in (1, 2)))
    new = with_fans({"fan1": {"Name": "fan1", "Status": ON}, "fan2": {"Name": "fan2", "Status": ON}})
    return (
        new | old | {CHASSIS: {"Id": "1U", "Thermal": link(f"{CHASSIS}/Thermal"), "ThermalSubsystem": link(SUBSYSTEM)}}
    )


def two(fan: dict[str, Any], other: dict[str, Any] | None = None) -> dict[str, Answer]:
    """Thermal with two fans."""
    return with_thermal({"Name": "F1", **fan}, {"Name": "F2", **(fan if other is None else other)})


SHAPES: dict[str, tuple[dict[str, Answer], dict[str, Any], tuple[float, float], tuple[float, float]]] = {
    "ReadingRPM, older Dell, Fujitsu, Huawei": (two({"ReadingRPM": 4100, **DUTY}), {}, (4100, 4100), (40, 40)),
    "Reading without a unit but of a size": (two({"Reading": 4100, **DUTY}), {}, (4100, 4100), (40, 40)),
    "a fan without a unit at 0, whose threshold is in rpm": (
        two({"Reading": 0, "LowerThresholdCritical": 616, **DUTY}),
        {},
        (0, 0),
        (40, 40),
    ),
    "numbers as text": (
        two({"Reading": "4100.000000", "ReadingUnits": "RPM", "Oem": {"Duty": "40 %"}}),
        {},
        (4100, 4100),
        (40, 40),
    ),
    "0 rpm is measured, null is not": (
        two({"Reading": 0, "ReadingUnits": "RPM", **DUTY}, {"Reading": None, "ReadingUnits": "RPM", **DUTY}),
        {},
        (0, NOTHING),
        (40, 40),
    ),
    "a fan that is off with its server": (
        two(
            {"Reading": 0, "ReadingUnits": "RPM", "Status": OFF, **DUTY},
            {"Reading": 4100, "ReadingUnits": "rpm", **DUTY},
        ),
        {},
        (NOTHING, 4100),
        (40, 40),
    ),
    "the speed where the user says": (two({"Now": {"Turns": 90}, **DUTY}), {"speed": "/Now/Turns"}, (90, 90), (40, 40)),
    "per cent of a stated rated speed": (
        two({"Reading": 12, "ReadingUnits": "Percent", **DUTY}),
        {"rated_rpm": 20_000},
        (2400, 2400),
        (40, 40),
    ),
    "speeds in Thermal, fans without in ThermalSubsystem": (thermal_and_subsystem(), {}, (5001, 5002), (40, 40)),
    "a fan that is listed and is not there": (
        with_fans(
            {"1": {"Name": "F1", "SpeedPercent": {"SpeedRPM": 4100}, **DUTY}, "2": {}},
            {f"{SUBSYSTEM}/Fans/2": 404},
        ),
        {},
        (4100, NOTHING),
        (40, NOTHING),
    ),
    "a fan whose object is no JSON": (
        with_fans({"1": {"SpeedPercent": {"SpeedRPM": 4100}, **DUTY}, "2": {}}, {f"{SUBSYSTEM}/Fans/2": b"<html>"}),
        {"fans": ["1", "2"]},
        (4100, NOTHING),
        (40, NOTHING),
    ),
    "the speed in the sensor that the fan names, the pwm in a sensor of the same name": (
        with_sensors(
            with_fans(
                {
                    name: {"Name": name, "SpeedPercent": {"DataSourceUri": f"{SENSORS}/fantach_{name}_RPM"}}
                    for name in ("SYS_FAN1", "SYS_FAN2")
                }
            ),
            fantach_SYS_FAN1_RPM=(4100, "RPM"),
            fantach_SYS_FAN2_RPM=("4200.0", "{rev}/min"),
            fanpwm_SYS_FAN1_PWM=(40, "%"),
            fanpwm_SYS_FAN2_PWM=(42, "%"),
        ),
        {},
        (4100, 4200),
        (40, 42),
    ),
    "speeds in sensors only": (
        with_sensors(
            with_fans({"fan0": {"Name": "fan0", "Status": ON}}),
            fantach_fan0_0=(4100, "RPM"),
            fantach_fan0_1=(4200, "RPM"),
            fanpwm_PWM0=(40, "%"),
        ),
        {"command": "fanpwm_PWM0"},
        (4100, 4200),
        (40, 40),
    ),
    "OpenBMC's Thermal lists the pwms as fans": (
        with_thermal(
            {"Name": "FAN0 TACH IL", "Reading": 4100, "ReadingUnits": "RPM"},
            {"Name": "FAN1 TACH IL", "Reading": 4200, "ReadingUnits": "RPM"},
            {"Name": "FAN0 PWM", "Reading": 40, "ReadingUnits": "Percent"},
            {"Name": "FAN1 PWM", "Reading": 42, "ReadingUnits": "Percent"},
        ),
        {},
        (4100, 4200),
        (40, 42),
    ),
    "the controllers of OpenBMC say which pwm drives which fan": (
        with_sensors(
            with_thermal(*({"Name": f"fan{n}", "Reading": 4000 + n, "ReadingUnits": "RPM"} for n in (1, 2))),
            fanpwm_Pwm_1=(40, "%"),
            fanpwm_Pwm_2=(50, "%"),
        )
        | {
            f"{ROOT}/Managers": {"Members": [link(f"{ROOT}/Managers/bmc")]},
            f"{ROOT}/Managers/bmc": {
                "Oem": {
                    "OpenBmc": {
                        "Fan": {"FanControllers": {"Fan_1": {"Inputs": ["fan1", "fan2"], "Outputs": ["Pwm 1"]}}}
                    }
                }
            },
        },
        {},
        (4001, 4002),
        (40, 40),
    ),
    "EnvironmentMetrics alone": (
        {
            CHASSIS: {"EnvironmentMetrics": link(f"{CHASSIS}/EnvironmentMetrics")},
            f"{CHASSIS}/EnvironmentMetrics": {
                "FanSpeedsPercent": [{"DeviceName": f"Chassis Fan {n}", "SpeedRPM": 11_843.0} for n in (1, 2)]
            },
            f"{ROOT}/Oem/Fans": {"Duty": 60},
        },
        {"command": f"{ROOT}/Oem/Fans#/Duty"},
        (11_843, 11_843),
        (60, 60),
    ),
    "other chassis that answer 404 and 500": (
        {f"{ROOT}/Chassis/Enclosure.0": 404, f"{ROOT}/Chassis/Card": 500} | two({"ReadingRPM": 4100, **DUTY}),
        {},
        (4100, 4100),
        (40, 40),
    ),
    "SpeedPercent in rpm beside SpeedRPM, Lenovo XCC2": (
        with_fans({n: {"SpeedPercent": {"Reading": 8611, "SpeedRPM": 8611}, **DUTY} for n in ("1", "2")}),
        {},
        (8611, 8611),
        (40, 40),
    ),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_speeds_and_commands_are_what_each_controller_means(shape: str) -> None:
    documents, settings, speed, command = SHAPES[shape]
    stated: dict[str, Any] = (
        {} if any("pwm" in str(each).lower() for each in documents.values()) else {"command": "/Oem/Duty"}
    )
    with redfish_server(Documents(documents)) as url:
        made = connected(url, **(stated | settings))
        for _ in range(2):
            found = reading(made)
            assert (found.speed, found.command) == (
                pytest.approx(speed, nan_ok=True),
                pytest.approx(command, nan_ok=True),
            )
        made.disconnect()


PERCENT = {"Reading": 12, "ReadingUnits": "Percent"}


@pytest.mark.parametrize(
    ("documents", "kind", "said"),
    [
        (
            two(PERCENT),
            "unknown_speed",
            "the controller gives per cent, no rpm: its fans cannot be judged without source.rated_rpm",
        ),
        (
            two({"CurrentReading": 15, "Units": "Percent"}),
            "unknown_speed",
            "the controller gives per cent, no rpm: its fans cannot be judged without source.rated_rpm",
        ),
        (
            two({"Reading": 41, "Oem": {"Duty": 40}, "LowerThresholdFatal": None}),
            "unknown_speed",
            "the object of F1 has no speed in rpm: say where by source.speed; it has Reading 41, Oem/Duty 40",
        ),
        (two({"Reading": None, "ReadingUnits": "RPM", "Status": OFF}), "fans_off", "all fans are off or absent"),
        (
            with_sensors(
                with_thermal({"Name": "Fan 1", "MemberId": "1", "Reading": 4100, "ReadingUnits": "RPM"}),
                fanpwm_Pwm_1=(40, "%"),
            ),
            "unknown_command",
            "no command is known: say where by source.command; Fan 1 has Reading 4100; pwms: fanpwm_Pwm_1",
        ),
    ],
)
def test_what_cannot_be_judged_is_one_line_that_says_what_is_there(
    documents: dict[str, Answer], kind: str, said: str
) -> None:
    with redfish_server(Documents(documents)) as url:
        refused = connected(url, 1 if "Pwm_1" in said else 2).read()
    assert isinstance(refused, Rejected) and (refused.kind, refused.is_sample) == (kind, True)
    assert refused.detail.startswith(said)


def test_the_measured_per_cent_is_no_command_and_speed_and_command_are_not_one_value() -> None:
    with pytest.raises(ValueError, match="is the measured speed in per cent of the rated one: no command"):
        device("https://bmc1", command="/SpeedPercent/Reading")
    with pytest.raises(ValueError, match="a twin of it could never be wrong"):
        device("https://bmc1", command="/Reading", speed="/Reading")


def test_a_named_chassis_is_the_only_one_that_is_asked_and_one_request_reads_all_fans_where_it_can() -> None:
    controller = Documents({f"{ROOT}/Chassis/Card": 500} | thermal_and_subsystem())
    with redfish_server(controller) as url:
        made = connected(f"{url}{CHASSIS}", command="/Oem/Duty")
        assert not any("Card" in path for path in controller.asked)
        made.read()
        controller.asked.clear()
        made.read()
        assert controller.asked == [f"{CHASSIS}/Thermal"]
        made.disconnect()


def test_a_fan_that_cannot_be_read_is_named_by_its_path_and_comes_back() -> None:
    controller = Documents(with_fans({n: {"SpeedPercent": {"SpeedRPM": 4100}, **DUTY} for n in ("1", "2")}))
    path, kept = f"{SUBSYSTEM}/Fans/2", controller.documents[f"{SUBSYSTEM}/Fans/2"]
    with redfish_server(controller) as url:
        made = connected(url, command="/Oem/Duty")
        notes: list[Any] = []
        made._deliver = lambda event: notes.extend(getattr(event, "items", ()))
        controller.documents[path] = 500
        assert math.isnan(reading(made).speed[1])
        assert [note.detail for note in notes] == [f"{path}: refused with HTTP status 500"]
        controller.documents["/redfish/v1/Oem/Fans"] = {"Duty": 40.0}
        elsewhere = connected(url, command="/redfish/v1/Oem/Fans#/Duty")
        assert [math.isnan(each) for each in reading(elsewhere).command] == [False, True], "no silent tacho"
        elsewhere.disconnect()
        controller.documents[path] = kept
        assert reading(made) == Reading((40.0, 40.0), (4100.0, 4100.0))
        made.disconnect()


DEEP = b'{"Fans": ' + 100_000 * b"["


@pytest.mark.parametrize(
    ("answer", "said"),
    [(403, "the user lacks rights (HTTP status 403)"), (DEEP, "no JSON, so no Redfish service"), (404, "refused with")],
)
def test_a_chassis_that_may_not_or_cannot_be_read_costs_itself(answer: Any, said: str) -> None:
    card = f"{ROOT}/Chassis/Card"
    with redfish_server(Documents({card: answer} | thermal_and_subsystem())) as url:
        made = connected(url, command="/Oem/Duty")
        assert not math.isnan(reading(made).speed[0])
        made.disconnect()
        with pytest.raises(DeviceError, match=f"^{card}: {re.escape(said)}") as caught:
            connected(f"{url}{card}")
        assert not caught.value.is_lost


def test_what_does_not_fit_the_controller_is_one_line() -> None:
    with redfish_server(Controller(is_new=True)) as url:
        with pytest.raises(DeviceError, match=r"^no fan 'FAN9'; there are: FAN1, 1, FAN2, 2"):
            connected(url, fans=["FAN9", "FAN1"]).read()
        with pytest.raises(DeviceError, match="^2 fans, this tray has 3"):
            connected(url, 3).read()
        with pytest.raises(DeviceError, match="^/redfish/v1/Chassis/Rack has no fans: let source.url"):
            connected(f"{url}/redfish/v1/Chassis/Rack")
        with pytest.raises(DeviceError, match="^/redfish/v1/Chassis/9U: refused with HTTP status 404"):
            connected(f"{url}/redfish/v1/Chassis/9U")
        with pytest.raises(DeviceError, match="^no sensor 'fanpwm_9' for the command; pwms there: none"):
            connected(url, command="fanpwm_9").read()


def test_a_controller_that_fails_or_is_slow_is_a_failed_poll_and_one_that_is_gone_is_lost(monkeypatch) -> None:
    controller = Controller(is_new=True)
    with redfish_server(controller) as url:
        made = connected(url)
        controller.status = 503
        with pytest.raises(DeviceError, match="^/redfish/v1/Chassis/1U/.*: refused with HTTP status 503") as caught:
            made.read()
        assert not caught.value.is_lost
        controller.status = 200
        made.disconnect()
        monkeypatch.setattr("fantwin.pipeline.sources.redfish.client.TIMEOUT_S", 2.0)
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
        settings: dict[str, Any] = {"folder": tmp_path, "verify": "ca.pem", "password_file": "bmc.secret"}
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
        assert SECRET not in str(caught.value) and caught.value.retry_s == 300.0
        file.write_text(f"{SECRET}\n")
        controller.has_sessions = True
        made = connected(url, **settings)
        assert reading(made).speed == (4000.0, 4200.0)
        made.disconnect()
        assert controller.ended == ["/redfish/v1/SessionService/Sessions/7"]
        settings["verify"] = False
        assert reading(connected(url, **settings)).speed == (4000.0, 4200.0)
    with pytest.raises(DeviceError, match="would send the password in the clear"):
        connected("http://operator@127.0.0.1:9", folder=tmp_path, password_file="bmc.secret")
    assert SECRET not in caplog.text
