"""Tables of simulated fans as a data scientist has them, and the recordings they are from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from fantwin import read_arrays
from tests.support.fantwin_command import as_typed

RPM = 30.0 / np.pi
FAULT = "inlet:fan=2,start=12,stop=30,size=1.6"


def record(folder: Path) -> None:
    """Write a recording of the demo's fans, one of which has a fault for a while, as `recorded.mcap`."""
    path = folder / "recorded.mcap"
    words = ("--fans", 8, "--profile", "manual", "--seed", 5, "--set", "epoch_ns=0", "--set", "speed_unit=rpm")
    done = as_typed("simulate", *words, "--duration", 20, "--fault", FAULT, "--recording", path)
    assert not done.returncode, done.stderr


def wide_table(recording: Path) -> pd.DataFrame:
    """The raw samples of a recording, a row for each time: `time` in s, `command_FAN`, `speed_FAN_rpm`."""
    blocks = list(read_arrays(recording, "raw"))
    t_ns, command, speed = (
        np.concatenate([block[name] for block in blocks]) for name in ("host_receive_t_ns", "command", "speed_rad_s")
    )
    columns = {"time": t_ns / 1e9}
    columns |= {f"command_{fan}": command[:, fan] for fan in range(command.shape[1])}
    columns |= {f"speed_{fan}_rpm": speed[:, fan] * RPM for fan in range(command.shape[1])}
    return pd.DataFrame(columns)


def long_table(wide: pd.DataFrame, fans: range = range(8)) -> pd.DataFrame:
    """The same, a row for each sample of a fan, fan after fan: `time`, `fan`, `command`, `speed_rpm`."""
    parts = [
        pd.DataFrame(
            {"time": wide["time"], "fan": fan, "command": wide[f"command_{fan}"], "speed_rpm": wide[f"speed_{fan}_rpm"]}
        )
        for fan in fans
    ]
    return pd.concat(parts, ignore_index=True)
