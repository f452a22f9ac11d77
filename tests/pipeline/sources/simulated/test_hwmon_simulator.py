"""The simulated driver behind a tree of files: what the source reads and writes there moves simulated fans."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fantwin.pipeline.cli.simulation import simulate
from fantwin.pipeline.cli.simulation.simulate import InjectedFaults, tachos_of
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.hwmon.config import HwmonConfig
from fantwin.pipeline.sources.hwmon.source import HwmonSource
from fantwin.pipeline.sources.simulated import hwmon
from fantwin.pipeline.sources.simulated.hwmon import HwmonTree, play_hwmon
from fantwin.pipeline.sources.source import Reading, SourceContext
from fantwin.schemas.tacho import Tacho
from fantwin.simulation.tacho import TachoSettings
from fantwin.simulation.tray import SimulatedTray, TraySettings
from tests.support.fantwin_command import fantwin

FAST = Tacho(kind="average", window_s=0.05)


def tray(**settings: float) -> SimulatedTray:
    return SimulatedTray(TraySettings(fans=2, rate_hz=100.0, tacho=TachoSettings((FAST,)), **settings))  # type: ignore[arg-type]


class _Stepped(threading.Event):
    """Lets a simulation run as fast as it can, for some samples."""

    def __init__(self, samples: int) -> None:
        super().__init__()
        self.left = samples

    def wait(self, timeout: float | None = None) -> bool:
        self.left -= 1
        return self.left < 0


def test_a_driver_drives_its_fans_until_they_are_taken_over(tmp_path: Path) -> None:
    root, fans = tmp_path / "hwmon", tray()
    tree = HwmonTree(root, "nct6798", 2)
    config = HwmonConfig(chip="nct6798", root=root, writable=True)
    device = HwmonSource(config, SourceContext(2, "rpm", Path()))
    device.connect()
    play_hwmon(fans, tree, _Stepped(100))
    automatic = device.read()
    assert isinstance(automatic, Reading)
    device.write((255.0, 64.0))
    play_hwmon(fans, tree, _Stepped(400))
    commanded = device.read()
    assert isinstance(commanded, Reading) and commanded.command == (255.0, 64.0)
    assert commanded.speed[0] > 1.5 * commanded.speed[1] > 0.0
    device.disconnect()
    play_hwmon(fans, tree, _Stepped(400))
    device.connect()
    again = device.read()
    assert isinstance(again, Reading) and again.command not in (automatic.command, commanded.command)
    assert int((root / "hwmon0" / "pwm1_enable").read_text()) == 2, "the profile of the driver goes on"
    tree.close()
    assert not root.exists()


def test_a_computer_that_is_too_slow_for_it_is_said_when_it_is_a_second_late_and_once_a_minute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sample of 0.05 s takes 0.1 s."""

    class SlowHost(_Stepped):
        def wait(self, timeout: float | None = None) -> bool:
            host.now_s += 0.1
            return super().wait(timeout)

    host = SimpleNamespace(now_s=0.0, time_ns=lambda: 0, monotonic=lambda: host.now_s)
    monkeypatch.setattr(hwmon, "time", host)
    monkeypatch.setattr(simulate, "clock", host)
    monkeypatch.setattr(simulate, "stop_on_signals", lambda: SlowHost(1300))
    done = fantwin("simulate", "--hwmon", tmp_path / "hw", "--fans", 1, "--set", "chip=emc2305")
    late = [
        line.partition(" s late: this computer is too slow")[0] for line in done.stderr.splitlines() if "late" in line
    ]
    assert late == ["1.1", "31.1", "61.1"], done.stderr


def test_a_command_is_not_written_over_by_the_driver_that_has_just_looked(tmp_path: Path) -> None:
    tree = HwmonTree(tmp_path / "hwmon", "nct6798", 2)
    _, automatic = tree.commands()
    chip = tmp_path / "hwmon" / "hwmon0"
    (chip / "pwm1_enable").write_text("1\n", encoding="utf-8")
    (chip / "pwm1").write_text("51\n", encoding="utf-8")
    tree.show(np.array([900.0, 900.0]), np.array([0.5, 0.5]), automatic)
    assert [int((chip / f"pwm{number}").read_text()) for number in (1, 2)] == [51, 128]


def test_a_fault_in_the_file_begins_when_it_is_written_and_ends_when_it_is_gone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, fans = tmp_path / "hwmon", tray()
    tree = HwmonTree(root, "nct6798", 2)
    injected = InjectedFaults(fans, root)

    def write(text: str) -> None:
        (root / "fault").write_text(text)
        injected._modified_ns = 0  # two writes within the resolution of the file's time
        injected.follow()

    play_hwmon(fans, tree, _Stepped(200), injected.follow)
    write("tacho-dropout:fan=1\n")
    play_hwmon(fans, tree, _Stepped(10), injected.follow)
    assert (root / "hwmon0" / "fan2_input").read_text().strip() == ""
    write("nonsense:fan=0\n")
    play_hwmon(fans, tree, _Stepped(10), injected.follow)
    assert int((root / "hwmon0" / "fan2_input").read_text()) > 0
    (fault,) = fans.settings.faults
    assert fault.kind == "tacho-dropout" and 1.9 < fault.start_s < fault.stop_s < 2.2
    shown = capsys.readouterr().err
    assert "fault injected: tacho-dropout:fan=1" in shown and "fault removed" in shown and "unknown kind" in shown


def test_each_fan_of_a_driver_of_single_fans_is_a_chip(tmp_path: Path) -> None:
    tree = HwmonTree(tmp_path / "hwmon", "pwmfan", 2)
    assert sorted(path.name for path in (tmp_path / "hwmon").glob("hwmon*")) == ["hwmon0", "hwmon1"]
    assert tachos_of("pwmfan") == (Tacho(kind="count", window_s=1.0),)
    tree.close()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter").touch()
    with pytest.raises(UserError, match="holds something else"):
        HwmonTree(tmp_path / "mine", "pwmfan", 2)
