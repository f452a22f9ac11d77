"""`fantwin doctor find`: what it finds on trees of files can be pasted as it is, and what is missing is said."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from fantwin.pipeline.config.loading import load_config, parse_config
from fantwin.pipeline.sources.hwmon.config import HwmonConfig
from fantwin.pipeline.sources.hwmon.discovery import discover_hwmon, discover_serial
from fantwin.pipeline.sources.kinds import build_source
from fantwin.pipeline.sources.source import SourceContext
from tests.support.fantwin_command import error_of, fantwin
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
    assert found[2].missing[0].startswith("fan2 has no pwm2, so its command is not known")
    assert any("not known" in note for note in found[2].notes)


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


def test_the_command_writes_a_new_configuration_and_prints_json(root: Path, tmp_path: Path) -> None:
    file = tmp_path / "fantwin.toml"
    words = ("doctor", "find", "--root", root, "--json", "--write", file, "--writable")
    result = fantwin(*words)
    assert result.exit_code == 0, result.output
    shown = json.loads(result.stdout)
    assert [each["tray"]["name"] for each in shown if each["kind"] == "hwmon"] == ["nct6798", "nct6798-2", "thinkpad"]
    config = load_config(file)
    assert [tray.source.kind for tray in config.trays] == ["hwmon"] * 3
    assert all(isinstance(tray.source, HwmonConfig) and tray.source.writable for tray in config.trays)
    assert "left out: acpitz" not in result.stderr, "it has no fans"
    text = file.read_text(encoding="utf-8")
    again = fantwin(*words)
    assert (again.exit_code, file.read_text(encoding="utf-8")) == (0, text)
    assert f"has all hwmon chips with fans already, not changed: {file}" in again.stderr
    file.write_text(text.replace('"thinkpad"', '"other"'), encoding="utf-8")
    lacks = "exists and was not changed: paste the [[tray]] that it lacks (thinkpad), or name a new file"
    assert error_of(*words) == f"{file}: {lacks}"


def test_a_port_of_which_nothing_is_known_is_no_tray_and_what_is_not_written_is_said(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ports = [ListPortInfo("/dev/ttyS0"), ListPortInfo("/dev/ttyUSB0")]
    ports[1].description, ports[1].hwid = "FT232R USB UART", "USB VID:PID=0403:6001"
    monkeypatch.setattr(list_ports, "comports", lambda: ports)
    known, unknown = discover_serial()
    assert known.tray["source"]["port"] == "/dev/ttyUSB0"
    assert not unknown.tray and unknown.title == "/dev/ttyS0" and "no device is known" in unknown.missing[0]
    shown = fantwin("doctor", "find", "--root", root, "--write", tmp_path / "fantwin.toml").stdout
    assert "\nleft out: /dev/ttyUSB0: FT232R USB UART: the device there is only guessed" in shown
    assert "\nleft out: /dev/ttyS0: no device is known there" in shown
