"""Recordings of simulated fans of a plant. Each seed has times of its own, as the recordings of a plant have."""

from __future__ import annotations

from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.replay.offline.calibration_of_twin import calibration_in
from fantwin.schemas.enums import Action, Severity, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import GIVES_FEEDBACK
from fantwin.scoring.calibration.calibration import Calibration
from fantwin.twin.evaluation.resampling import thinned
from fantwin.twin.export.onnx_export import with_card_entries
from fantwin.twin.runs import Run
from tests.support.fan_data import published_run
from tests.support.small_recordings import write
from tests.support.written_recordings import write_run

EPOCH_NS = 1_790_000_000 * NS_PER_S
FANS = 2
HEALTHY_S, OTHER_S = 60, 30
"""length of the recording of the calibration, and of each of the others"""
PER_DAY = 3000
"""false alarms that are declared: as few as a minute can support"""
FAULT_S = (10, 25)
"""begin and end of the fault of the last fan of a recording that has one"""


def start_ns(seed: int) -> int:
    """The first time in the recording of a seed."""
    return EPOCH_NS + seed * 1_000 * NS_PER_S


def recorded(
    path: Path,
    seed: int,
    seconds: float,
    *,
    fans: int = FANS,
    has_fault: bool = False,
    fault_s: tuple[int, int] = FAULT_S,
) -> Path:
    """Published fans under stairs, the last of which turns at 0.4 of its speed during a fault."""
    run = thinned(published_run(seed, seconds, fans), 5)  # 20 Hz, which is scored in a fifth of the time
    speed_rad_s = run.speed_rad_s.copy()
    if has_fault:
        speed_rad_s[(run.t_s >= fault_s[0]) & (run.t_s < fault_s[1]), -1] *= 0.4
    return write_run(path, Run(run.name, run.t_s + start_ns(seed) / NS_PER_S, run.command, speed_rad_s))


FAULTY_NS = start_ns(5)


def with_alarm(path: Path, action: Action | None) -> Path:
    """A recording that has nothing but the alarm of the fault, and what an operator says of it."""
    onset_t_ns, cleared_t_ns = (FAULTY_NS + second * NS_PER_S for second in FAULT_S)
    state: dict[str, Any] = {"fan": 1, "severity": Severity.ALARM, "onset_t_ns": onset_t_ns, "message": "slow"}
    state |= {"residual_rad_s": 1.0, "residual_std_rad_s": 1.0}
    alarms = [
        Alarm(**state, active=True, t_ns=onset_t_ns + NS_PER_S, transition=Transition.RAISED),
        Alarm(**state, active=False, t_ns=cleared_t_ns + NS_PER_S, transition=Transition.CLEARED),
    ]
    if action is not None:
        said = {"transition": GIVES_FEEDBACK[action][0], "marked_onset_t_ns": onset_t_ns, "operator_name": "ann"}
        alarms.append(Alarm(**state, **said, active=False, t_ns=cleared_t_ns + 60 * NS_PER_S, comment="door"))
    messages = [replace(each, header=Header("scorer-1", number, "tray1")) for number, each in enumerate(alarms)]
    return write(path, messages, {"site": "plant", "trays": "tray1"}, at=attrgetter("t_ns"))


def calibration_of(twin: Path) -> Calibration:
    calibration = calibration_in(twin, load_tray_twin(twin))
    assert calibration
    return calibration


def changed(path: Path, calibrated: Path, **changes: Any) -> Path:
    """The twin with another calibration."""
    entry = calibration_of(calibrated).model_dump(mode="json") | changes
    path.write_bytes(with_card_entries(calibrated.read_bytes(), {"calibration": entry}))
    return path
