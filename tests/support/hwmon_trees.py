"""Trees of files such as /sys/class/hwmon, chip by chip."""

from __future__ import annotations

from pathlib import Path


def add_chip(root: Path, number: int, name: str, device: str, files: dict[str, int | str]) -> Path:
    """A folder hwmonN with the files of a chip; `device` is the path of its device below the folder `devices`."""
    folder, its_device = root / f"hwmon{number}", root.parent / "devices" / device
    folder.mkdir(parents=True)
    its_device.mkdir(parents=True, exist_ok=True)
    (folder / "device").symlink_to(its_device)
    for file, value in {"name": name, **files}.items():
        (folder / file).write_text(f"{value}\n")
    return folder


def board(root: Path, number: int = 0, device: str = "platform/nct6775.656") -> Path:
    """A chip with three fans, of which the last is not connected, temperatures and voltages."""
    files: dict[str, int | str] = {"temp2_input": 31500, "temp3_input": 128000, "in0_input": 1008}
    for fan, (rpm, pwm, mode) in enumerate(((900, 120, 5), (1200, 140, 5), (0, 255, 1)), 1):
        files |= {f"fan{fan}_input": rpm, f"pwm{fan}": pwm, f"pwm{fan}_enable": mode}
    return add_chip(root, number, "nct6798", device, files)
