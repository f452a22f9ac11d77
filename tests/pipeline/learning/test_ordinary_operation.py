"""When a plant has moved its fans enough to train on."""

from __future__ import annotations

import numpy as np

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.learning.ordinary_operation import OrdinaryOperation
from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S

TRAY = TrayConfig.model_validate({"name": "tray1", "fans": 2, "command_max": 100.0})


def samples(commands: np.ndarray, first_s: float = 0.0, period_s: float = 0.5) -> Raw:
    """Samples of two fans; commands: (n, 2)."""
    n = len(commands)
    t_ns = ((first_s + period_s * np.arange(n)) * NS_PER_S).astype(np.int64)
    return Raw(
        fans=2,
        host_receive_t_ns=t_ns,
        device_clock_us=np.zeros(n, np.uint32),
        device_sequence=np.arange(n, dtype=np.uint32),
        command=commands,
        speed_rad_s=np.ones((n, 2)),
    )


def stairs(levels: list[float], held: int = 50) -> np.ndarray:
    """Two fans, of which the second holds the first level."""
    moved = np.repeat(levels, held)
    return np.column_stack((moved, np.full(len(moved), levels[0])))


def test_a_fan_has_moved_enough_after_enough_levels_and_changes_and_the_others_are_named() -> None:
    operation = OrdinaryOperation(TRAY)
    assert (
        operation.missing()[0]
        == "fan 0: no command yet, 20 s each in 0 tenths of 0 to 100 (4 needed), 0 changes (10 needed)"
    )
    operation.take(samples(stairs([20.0, 45.0, 70.0, 95.0, 20.0, 45.0])))
    first, second = operation.missing()
    assert first == "fan 0: commands 20 to 95, 20 s each in 4 tenths of 0 to 100 (4 needed), 5 changes (10 needed)"
    assert second == "fan 1: command 20, 20 s each in 1 tenths of 0 to 100 (4 needed), 0 changes (10 needed)"
    operation.take(samples(stairs([20.0, 45.0, 70.0, 95.0, 20.0]), first_s=150.0))
    (left,) = operation.missing()
    assert left.startswith("fan 1:")
    assert operation.held() == ["fan 1: command 20"]


def test_a_command_that_flickers_between_two_ranges_does_not_change_and_gaps_do_not_count() -> None:
    operation = OrdinaryOperation(TRAY)
    flickers = np.where(np.arange(400) % 2 == 0, 29.9, 30.1)
    operation.take(samples(np.column_stack((flickers, flickers))))
    assert operation.held() == ["fan 0: commands 29.9 to 30.1", "fan 1: commands 29.9 to 30.1"]
    sparse = OrdinaryOperation(TRAY)
    sparse.take(samples(stairs([20.0, 45.0], held=10), period_s=10.0))
    assert (
        sparse.missing()[0]
        == "fan 0: commands 20 to 45, 20 s each in 0 tenths of 0 to 100 (4 needed), 1 changes (10 needed)"
    )
