"""The hwmon chips of this computer: each that has fans is a tray that works as it is, and what is missing is said."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.sources.hwmon.config import HwmonConfig
from fantwin.pipeline.sources.hwmon.discovery import discover_hwmon
from fantwin.pipeline.sources.kinds import build_source
from fantwin.pipeline.sources.source import SourceContext
from tests.support.hwmon_trees import add_chip, board


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "hwmon"
    add_chip(root, 0, "acpitz", "virtual/thermal", {"temp1_input": 30000})
    board(root, 2, "i2c-1/1-002f")
    board(root, 7, "i2c-2/2-002f")
    add_chip(root, 8, "thinkpad", "platform/thinkpad_hwmon", {"fan1_input": 3000, "fan2_input": 3100, "pwm1": 128})
    return root


def test_each_chip_with_fans_is_a_tray_that_reads_what_is_there(root: Path) -> None:
    found = list(discover_hwmon(root))
    assert [each.tray["name"] for each in found] == ["nct6798", "nct6798-2", "thinkpad"]
    config = parse_config("\n".join(each.toml for each in found), Path("fantwin.toml"))
    for tray in config.trays:
        assert isinstance(tray.source, HwmonConfig) and not tray.source.writable
        assert build_source(tray.source, SourceContext(tray.fans, tray.speed_unit, Path())).check() == []
    first = found[0]
    assert first.tray["source"]["chip"].endswith("@1-002f") and first.tray["source"]["fans"] == [1, 2]
    assert "fan3 at 0 rpm although commanded to turn, left out: not connected?" in first.missing
    assert first.notes[:2] == ("fan 0 is fan1_input: 900 rpm", "fan 1 is fan2_input: 1200 rpm")
    assert "# fan 0 is fan1_input: 900 rpm\n" in first.toml
    assert any(note.startswith("measures average over 0.05 s") for note in first.notes)
    assert found[2].missing[0].startswith("thinkpad has no pwm2, so the command of fan2 is not known")
    assert "nct6798@1-002f/pwm1" in found[2].missing[0]
    assert any("not known" in note for note in found[2].notes)


def test_a_chip_without_pwm_is_commanded_in_rpm_or_named_as_one_that_cannot_be_watched(tmp_path: Path) -> None:
    files: dict[str, int | str] = {}
    for fan, rpm in ((1, 1147), (2, 1760)):
        files |= {f"fan{fan}_input": rpm, f"fan{fan}_output": rpm, f"fan{fan}_max": 21_500 + fan}
    add_chip(tmp_path / "hwmon", 0, "applesmc", "x/0", files)
    add_chip(tmp_path / "hwmon", 1, "asus", "x/1", {"fan1_input": 2400, "pwm1_enable": 2})
    add_chip(tmp_path / "hwmon", 2, "thinkpad", "x/2", {"fan1_input": 0xFFFF, "pwm1": 255, "pwm1_enable": 2})
    mac, asus, thinkpad = discover_hwmon(tmp_path / "hwmon")
    assert mac.tray["source"]["pwms"] == ["fan1_output", "fan2_output"] and mac.tray["command_max"] == 21_502
    (tray,) = parse_config(mac.toml, Path("fantwin.toml")).trays
    assert build_source(tray.source, SourceContext(2, "rpm", Path())).check() == []
    (asus_lacks,) = asus.missing
    assert not asus.tray and asus_lacks.startswith(
        "asus has no pwm and no set-point, so the command of its fans is not"
    )
    assert thinkpad.missing == (
        "fan1_input is 65535, which is no measurement: its speed is missing until there is one",
        "in automatic mode (pwm1_enable is 2) thinkpad/pwm1 is not the command "
        "(Documentation/admin-guide/laptops/thinkpad-acpi.rst)",
    )


@pytest.mark.parametrize(("rpm", "is_said"), [(335, False), (1500, True)])
def test_a_limit_of_the_driver_that_a_reading_contradicts_is_not_said(tmp_path: Path, rpm: int, is_said: bool) -> None:
    add_chip(tmp_path / "hwmon", 0, "emc2305", "i2c/0", {"fan1_input": rpm, "pwm1": 120, "pwm1_enable": 1})
    (found,) = discover_hwmon(tmp_path / "hwmon")
    assert ("reads 0 below 960 rpm" in found.notes) is is_said


def test_a_fan_is_called_as_the_kernel_calls_it_or_as_its_chip_counts_it(root: Path) -> None:
    def names() -> list[str]:
        trays = parse_config(next(iter(discover_hwmon(root))).toml, Path("fantwin.toml")).trays
        return list(trays[0].names.names)

    labels = root / "hwmon2" / "fan1_label", root / "hwmon2" / "fan2_label"
    assert names() == ["fan1", "fan2"]
    for written, expected in (
        ("CPU Fan", "CPU Fan"),
        ("Lüfter", "Lüfter"),
        ("2", "fan1"),
        ("a\tb", "fan1"),
        ("", "fan1"),
    ):
        labels[0].write_text(f"{written}\n", encoding="utf-8")
        assert names() == [expected, "fan2"]
    for label in labels:
        label.write_text("System Fan\n", encoding="utf-8")
    assert names() == ["fan1", "fan2"], "a name of two fans is none"


def test_no_tree_one_without_fans_and_one_that_may_not_be_written_say_what_is_missing(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (none,) = discover_hwmon(tmp_path / "none")
    assert not none.tray and none.missing[0].startswith("no such folder: this system has no hwmon")
    add_chip(tmp_path / "bare", 0, "k10temp", "pci/0", {"temp1_input": 1})
    (bare,) = discover_hwmon(tmp_path / "bare")
    assert bare.missing[0].startswith("no chip with a fan; chips: k10temp; load the driver")
    monkeypatch.setattr(os, "access", lambda path, _mode: not str(path).endswith("pwm1"))
    assert "this user may not write pwm1" in next(iter(discover_hwmon(root))).missing[-1]
