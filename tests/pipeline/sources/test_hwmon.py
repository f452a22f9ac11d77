"""Fans of this computer, on trees of files: which chip, what is read, what is written, and what goes wrong."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.hwmon.config import HwmonConfig
from fantwin.pipeline.sources.hwmon.drive import Drive
from fantwin.pipeline.sources.hwmon.source import HwmonSource
from fantwin.pipeline.sources.polling import DeviceError
from fantwin.pipeline.sources.source import Reading, Rejected, SourceContext
from fantwin.schemas.channels import CURRENT, SUPPLY_VOLTAGE, TEMPERATURE
from fantwin.schemas.tacho import Tacho
from tests.support.delivered import Delivered
from tests.support.hwmon_trees import add_chip, board

NAN = float("nan")


def device(root: Path, count: int = 2, unit: str = "rpm", **settings: Any) -> HwmonSource:
    config = HwmonConfig.model_validate({"chip": "nct6798", "root": root, **settings})
    return HwmonSource(config, SourceContext(count, unit, Path()))


def connected(root: Path, count: int = 2, **settings: Any) -> HwmonSource:
    made = device(root, count, **settings)
    made.connect()
    return made


def reading(made: HwmonSource) -> Reading:
    found = made.read()
    assert isinstance(found, Reading)
    return found


def listened(made: HwmonSource) -> Delivered:
    """What it says from now on, as if it were polled."""
    made._deliver = (delivered := Delivered()).append
    return delivered


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "hwmon"


def test_speeds_commands_and_what_is_asked_for_are_read_in_units_of_the_tray(root: Path) -> None:
    board(root)
    made = connected(root, fans=[2, 1], temperatures=[2, 3], voltages=[0], voltage_scale=12)
    found = reading(made)
    assert found.speed == (1200.0, 900.0) and found.command == (140.0, 120.0)
    assert found.measured[TEMPERATURE][0] == 31.5 and math.isnan(found.measured[TEMPERATURE][1]), (
        "a sensor that is not connected"
    )
    assert found.measured[SUPPLY_VOLTAGE] == pytest.approx((12.096, 12.096)) and CURRENT not in found.measured
    in_rad_s = device(root, unit="rad/s")
    in_rad_s.connect()
    assert reading(in_rad_s).speed[1] == pytest.approx(1200 * math.pi / 30)


def test_a_chip_is_found_by_its_name_whatever_its_number_is(root: Path) -> None:
    add_chip(root, 0, "acpitz", "virtual/thermal", {"temp1_input": 1})
    board(root, 4)
    made = connected(root)
    assert reading(made).speed == (900.0, 1200.0)
    # The driver is loaded again: another chip has its number now.
    (root / "hwmon4").rename(root / "hwmon5")
    add_chip(root, 4, "k10temp", "pci/0", {"temp1_input": 1})
    with pytest.raises(DeviceError, match="hwmon4 is k10temp now, no longer nct6798") as caught:
        made.read()
    assert caught.value.is_lost
    made.disconnect()
    made.connect()
    assert reading(made).speed == (900.0, 1200.0)


def test_two_chips_of_one_name_are_told_apart_by_their_devices(root: Path) -> None:
    board(root, 0, "i2c-1/1-002f")
    other = board(root, 1, "i2c-1/1-0020")
    (other / "fan1_input").write_text("450\n")
    with pytest.raises(
        DeviceError, match="2 chips are called nct6798: name one by chip = 'nct6798@1-0020', 'nct6798@1-002f'"
    ):
        connected(root)
    assert reading(connected(root, chip="nct6798@1-0020")).speed[0] == 450.0
    with pytest.raises(DeviceError, match="no chip is called nct6798@1-00 in"):
        connected(root, chip="nct6798@1-00")


def test_files_that_cannot_be_read_are_nan_and_a_reading_without_any_command_is_refused(root: Path) -> None:
    folder = board(root)
    made = connected(root)
    (folder / "fan1_input").write_text("\n")  # as a driver whose measurement failed
    assert math.isnan(reading(made).speed[0]) and reading(made).speed[1] == 1200.0
    (folder / "fan2_fault").write_text("1\n")
    assert math.isnan(reading(made).speed[1]), "the chip does not trust it"
    (folder / "fan2_input").write_text("0\n")
    assert reading(made).speed[1] == 0.0, "a fan that stands is measured"
    (folder / "pwm1").write_text("\n")
    noted = listened(made)
    found = reading(made)
    assert math.isnan(found.command[0]) and found.command[1] == 140.0, "one command costs its own fan"
    assert noted.noted == ["unknown_drives: nct6798/pwm1 cannot be read: holds '', no number"]
    (folder / "pwm2").write_text("\n")
    refused = made.read()
    assert isinstance(refused, Rejected) and refused.kind == "unknown_command" and refused.is_sample


def test_a_commanded_fan_is_taken_over_and_given_back(root: Path) -> None:
    folder = board(root)
    made = connected(root, 3, writable=True)
    made.write((200.4, NAN, 90.0))
    written = {
        file: int((folder / file).read_text()) for file in ("pwm1", "pwm1_enable", "pwm2", "pwm2_enable", "pwm3")
    }
    assert written == {"pwm1": 200, "pwm1_enable": 1, "pwm2": 140, "pwm2_enable": 5, "pwm3": 90}
    made.disconnect()
    assert (folder / "pwm1_enable").read_text().strip() == "5"
    assert (folder / "pwm3").read_text().strip() == "255", "a fan that was manual gets its former pwm"


def test_what_a_killed_process_took_over_is_given_back_by_the_next_one(root: Path, tmp_path: Path) -> None:
    folder = board(root)
    config = HwmonConfig(chip="nct6798", root=root, writable=True)
    context = SourceContext(3, "rpm", Path(), "a", run_folder=tmp_path / "runs")
    modes = [folder / f"pwm{number}_enable" for number in (1, 2)]

    def started() -> HwmonSource:
        made = HwmonSource(config, context)
        made.connect()
        return made

    started().write((30.0, 40.0, 50.0))  # killed: it does not disconnect
    second = started()
    second.write((60.0, NAN, NAN))
    assert [mode.read_text() for mode in modes] == ["1", "1"]
    second.disconnect()
    assert [mode.read_text() for mode in modes] == ["5", "5"], "also the one that it did not write"
    assert (folder / "pwm3").read_text() == "255"
    assert list(context.run_folder.iterdir() if context.run_folder else ()) == []

    started().write((30.0, NAN, NAN))
    modes[0].write_text("2")  # the driver is loaded again
    third = started()
    third.disconnect()
    assert modes[0].read_text() == "2"
    third.connect()
    third.write((30.0, NAN, NAN))
    third.disconnect()
    assert modes[0].read_text() == "2", "as it was found last"


def test_a_pwm_whose_mode_cannot_be_kept_is_not_taken_over(root: Path, tmp_path: Path) -> None:
    folder = board(root)
    (tmp_path / "runs").write_text("a file in the place of the folder")
    made = HwmonSource(
        HwmonConfig(chip="nct6798", root=root, writable=True),
        SourceContext(3, "rpm", Path(), "a", run_folder=tmp_path / "runs"),
    )
    made.connect()
    for _ in range(2):
        with pytest.raises(DeviceError, match="the modes of pwms cannot be kept in run_folder"):
            made.write((200.0, NAN, NAN))
    assert [(folder / name).read_text().strip() for name in ("pwm1_enable", "pwm1")] != ["1", "200"]


def test_fans_that_share_a_pwm_take_one_command(root: Path) -> None:
    folder = board(root)
    made = connected(root, 3, pwms=[1], writable=True)
    for command, pwm in (((200.0, NAN, NAN), "200"), ((NAN, 90.0, NAN), "90"), ((80.0, NAN, 80.0), "80")):
        made.write(command)
        assert (folder / "pwm1").read_text() == pwm
    with pytest.raises(DeviceError, match="pwm1 moves several fans: give them one command, not 10 and 20"):
        made.write((10.0, NAN, 20.0))
    assert (folder / "pwm1").read_text() == "80"


def test_chips_that_say_less_than_others_are_known(root: Path) -> None:
    dell = {"fan1_input": 2500, "pwm1": 128, "pwm1_enable": ""}
    folder = add_chip(root, 0, "dell_smm", "platform/dell_smm_hwmon", dell)
    made = connected(root, 1, chip="dell_smm", writable=True)
    made.write((255.0,))
    assert (folder / "pwm1_enable").read_text() == "1"
    made.disconnect()
    assert (folder / "pwm1_enable").read_text() == "2", "its automatic mode, which cannot be read"
    add_chip(root, 1, "corsaircpro", "usb/1-4", {"fan1_input": 800, "pwm1": 0})
    made = connected(root, 1, chip="corsaircpro", writable=True)
    refused = made.read()
    assert isinstance(refused, Rejected) and refused.kind == "unknown_command" and refused.is_sample
    made.write((0.0,))
    assert reading(made).command == (0.0,), "known once it was set"


def test_a_fan_that_firmware_or_a_program_has_taken_back_is_said_and_taken_over_at_the_next_command(root: Path) -> None:
    folder = board(root)
    made = connected(root, writable=True)
    noted = listened(made)
    made.write((200.0, 90.0))
    reading(made)
    (folder / "pwm1_enable").write_text("5")  # the computer wakes from suspend
    (folder / "pwm1").write_text("118")
    assert [reading(made).command[0] for _ in range(3)] == [118.0] * 3, "what the chip shows is the command"
    again = "taken_back: nct6798/pwm1: mode 5 instead of manual; the next command sets it again"
    assert noted.noted == [again], "once, however often it is polled"
    assert (folder / "pwm1_enable").read_text() == "5", "the firmware may have done it against heat"
    made.write((210.0, NAN))
    assert [(folder / name).read_text() for name in ("pwm1_enable", "pwm1")] == ["1", "210"]
    (folder / "pwm1_enable").write_text("2")  # and before the next poll
    made.write((220.0, NAN))
    assert noted.noted[1:] == ["taken_back: nct6798/pwm1: mode 2 instead of manual, set to manual again"]
    made.disconnect()
    assert (folder / "pwm1_enable").read_text() == "5", "as it was found before the first command"


def test_a_pwm_that_another_program_sets_is_said_once_and_one_that_a_chip_rounds_is_not(root: Path) -> None:
    folder = board(root)
    made = connected(root, writable=True)
    noted = listened(made)
    made.write((200.0, 90.0))
    (folder / "pwm1").write_text("182")  # a chip with eight levels
    for shown in (182, 182, 182, 60, 60, 60):
        (folder / "pwm1").write_text(str(shown))
        reading(made)
    assert noted.noted == ["changed_by_others: nct6798/pwm1 shows 60 after the command 200"]
    made.write((200.0, NAN))
    (folder / "pwm1").write_text("118")  # never what was written
    for _ in range(3):
        assert reading(made).command[0] == 118.0
    assert noted.noted[1:] == ["changed_by_others: nct6798/pwm1 shows 118 after the command 200"]


def test_firmware_that_does_not_give_a_fan_up_refuses_the_command(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    board(root)
    made = connected(root, writable=True)
    monkeypatch.setattr(Drive, "mode", lambda _drive: 5)
    with pytest.raises(
        DeviceError, match=r"nct6798/pwm1_enable remains 5 after 1 \(manual\) was written: the firmware"
    ):
        made.write((200.0, NAN))


def test_a_pwm_that_is_not_in_force_is_no_command(root: Path) -> None:
    laptop = add_chip(root, 0, "thinkpad", "x/0", {"fan1_input": 0xFFFF, "pwm1": 255, "pwm1_enable": 2})
    made = connected(root, 1, chip="thinkpad", writable=True)
    noted = listened(made)
    refused = made.read()
    assert isinstance(refused, Rejected) and refused.detail.startswith("in automatic mode (pwm1_enable is 2)")
    assert noted.noted == ["no_measurement: fan1_input is 65535, which is no measurement"]
    made.write((128.0,))
    (laptop / "fan1_input").write_text("3000")
    assert (reading(made).command, reading(made).speed) == ((128.0,), (3000.0,))
    (laptop / "pwm1_enable").write_text("0")  # full speed, whatever pwm1 is
    assert isinstance(made.read(), Rejected)


@pytest.mark.parametrize(
    ("chip", "files", "drive", "why"),
    [
        ("it8720", {"pwm1": 80, "pwm1_enable": 2}, 1, "in automatic mode (pwm1_enable is 2) it8720/pwm1 is not the"),
        ("it8720", {"pwm1": 80, "pwm1_enable": 1}, 1, ""),
        ("it8728", {"pwm1": 80, "pwm1_enable": 2}, 1, ""),
        ("nct6687", {"pwm1": 80, "pwm1_enable": 99}, 1, ""),
        (
            "amdgpu",
            {"fan1_target": 80, "fan1_enable": 0},
            "fan1_target",
            "amdgpu/fan1_target is not in force: fan1_enable",
        ),
        ("amdgpu", {"fan1_target": 80, "fan1_enable": 1}, "fan1_target", ""),
        ("macsmc_hwmon", {"fan1_target": 80, "fan1_manual": 0}, "fan1_target", ""),
        ("uniwill", {"pwm1": "", "pwm1_enable": 2}, 1, "uniwill/pwm1 cannot be read"),
        ("corsairpsu", {}, 1, "corsairpsu has no pwm: name what drives its fans in pwms"),
    ],
)
def test_the_command_of_a_chip_is_the_one_in_force_or_none(
    root: Path, chip: str, files: dict[str, int | str], drive: int | str, why: str
) -> None:
    add_chip(root, 0, chip, "x/0", {"fan1_input": 900, **files})
    made = connected(root, 1, chip=chip, pwms=[drive])
    if not files:
        assert made.check()[0].startswith(why)
        return
    found = made.read()
    if why:
        assert isinstance(found, Rejected) and found.detail.startswith(why)
    else:
        assert isinstance(found, Reading) and found.command == (80.0,)


def test_set_points_in_rpm_and_pwms_of_other_chips_drive_fans(root: Path) -> None:
    files: dict[str, int | str] = {}
    for fan, rpm in ((1, 1147), (2, 1760)):
        files |= {f"fan{fan}_input": rpm, f"fan{fan}_output": rpm + 3, f"fan{fan}_manual": 0}
    mac = add_chip(root, 0, "applesmc", "platform/applesmc.768", files)
    other = board(root, 1)
    tacho = add_chip(root, 2, "tacho", "x/0", {"fan1_input": 4000})

    made = connected(root, chip="applesmc", pwms=["fan1_output", "fan2_output"], writable=True)
    assert reading(made).command == (1150.0, 1763.0)
    made.write((2000.0, NAN))
    assert [(mac / f).read_text() for f in ("fan1_manual", "fan1_output", "fan2_manual")] == ["1", "2000", "0\n"]
    made.disconnect()
    assert (mac / "fan1_manual").read_text() == "0"

    made = connected(root, 1, chip="tacho", pwms=["nct6798/pwm2"], writable=True, speed_scales=[0.5])
    assert (reading(made).command, reading(made).speed) == ((140.0,), (2000.0,)), "four pulses a revolution"
    made.write((90.0,))
    assert [(other / f).read_text() for f in ("pwm2_enable", "pwm2")] == ["1", "90"]
    made.disconnect()
    assert (other / "pwm2_enable").read_text() == "5" and not (tacho / "pwm2_enable").exists()

    assert device(root, chip="applesmc").check()[0] == (
        "applesmc has no pwm: name its set-points in rpm, pwms = ['fan1_output', 'fan2_output']"
    )
    assert device(root, 1, chip="tacho").check() == ["tacho has no pwm: name what drives its fans in pwms (CHIP/pwm1)"]
    (wrong,) = device(root, 1, chip="tacho", pwms=["it8728/pwm1"]).check()
    assert wrong.startswith("no chips are called it8728; there are: applesmc, nct6798, tacho; correct pwms")


def test_what_a_source_cannot_do_is_said_before_it_starts(root: Path) -> None:
    board(root)
    assert device(root).check() == []
    made = device(root, 3, fans=[1, 2, 7], temperatures=[9], pwms=[1])
    assert made.check() == [
        "nct6798 has no fan7_input: correct fans",
        "nct6798 has no temp9_input: correct temperatures",
    ]
    assert device(root, chip="it8728").check()[0].startswith("no chip is called it8728")
    with pytest.raises(UserError, match=r"fans = 3, and source.fans names 2"):
        device(root, 3, fans=[1, 2])
    with pytest.raises(UserError, match=r"source.pwms names 2: give one for all fans, or 3"):
        device(root, 3, pwms=[1, 2])
    assert device(root).send((10.0, 10.0), ()) == "its source does not have writable = true"


@pytest.mark.parametrize(
    ("chip", "tacho"),
    [
        ("nct6687", Tacho(kind="average", window_s=0.05, update_s=1.0)),
        ("pwmfan", Tacho(kind="count", pulses=2, window_s=1.0)),
        ("nct6798", Tacho(kind="average", window_s=0.05, update_s=1.5)),
        ("max31790", Tacho(kind="average", window_s=0.05, update_s=1.0)),
        ("unheard-of", Tacho()),
    ],
)
def test_the_driver_says_what_is_measured(chip: str, tacho: Tacho) -> None:
    text = f'[[tray]]\nname = "a"\nfans = 2\nsource = {{ kind = "hwmon", chip = "{chip}" }}\n'
    assert parse_config(text, Path("fantwin.toml")).trays[0].tachos == (tacho,)
