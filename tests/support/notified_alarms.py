"""Alarms and targets for tests of the notifier, and a notifier in this process whose clock the test moves."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Any

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.notify.config import NotifierConfig
from fantwin.pipeline.runtime.stage import Context
from fantwin.schemas.enums import Severity, Transition
from fantwin.schemas.messages import Alarm, Diagnosis
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.notifier import NotifierCore, build
from tests.support import made_messages

SITE, TRAY = "hall", "tray1"
START_NS = 1_790_000_000 * NS_PER_S
CAUSES = (
    Diagnosis(cause="drag_up", probability=0.8, evidence="drag +20 %"),
    Diagnosis(cause="friction_up", probability=0.2),
)
_sequences = iter(range(1 << 40))


def alarm(
    transition: Transition = Transition.RAISED,
    fan: int = 2,
    tray: str = TRAY,
    onset_s: float = 0.0,
    sequence: int | None = None,
    producer: str = "scorer-all-1",
    **more: Any,
) -> Alarm:
    """A transition; without `sequence` a later one than all before."""
    values: dict[str, Any] = {
        "residual_rad_s": 9.0,
        "residual_std_rad_s": 5.0,
        "message": f"fan {fan}: 90 rpm below the twin (limit 50); more drag, 80 %: drag +20 %",
        **{"severity": Severity.WARNING, "transition": transition, "causes": CAUSES},
        **{"t_ns": START_NS, "onset_t_ns": START_NS + round(onset_s * NS_PER_S)},
    }
    number = next(_sequences) if sequence is None else sequence
    return made_messages.alarm(fan, tray=tray, producer=producer, sequence=number, **(values | more))


def cleared(fan: int = 2, **more: Any) -> Alarm:
    return alarm(Transition.CLEARED, fan, active=False, message=f"fan {fan}: back to normal", **more)


def secret(folder: Path, name: str, url: str) -> Path:
    """A file with a URL that only its owner reads."""
    path = folder / f"{name}.url"
    path.write_text(f"{url}\n")
    path.chmod(stat.S_IRUSR | stat.S_IWUSR)
    return path


def notifier_core(folder: Path, config: NotifierConfig, trays: dict[str, int] | None = None) -> NotifierCore:
    """A notifier with its outbox in a folder. Its first look is over once `tick` has got a time 10 s later."""
    rooms = tuple(TrayConfig(name=name, fans=fans) for name, fans in (trays or {TRAY: 8}).items())
    core = build(Context(SITE, rooms, config, folder, folder, 0)).core
    assert isinstance(core, NotifierCore)
    return core
