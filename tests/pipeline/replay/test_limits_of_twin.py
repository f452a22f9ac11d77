"""pipeline.replay.offline.limits_of_twin: calibration gets what the cards say about the fans."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.replay.offline import limits_of_twin
from pipeline.runtime.tray_twin import TrayTwin, load_tray_twin
from schemas.tacho import Tacho
from schemas.twin_card import DriveCard
from scoring.limits import Timing
from tests.support.twin_files import write_twin


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> TrayTwin:
    return load_tray_twin(write_twin(tmp_path_factory.mktemp("twin") / "twin.onnx", fans=2))


def with_a_drive(twin: TrayTwin) -> TrayTwin:
    drive = DriveCard(turning_command=5.0, kick_s=1.0, rest_s=2.0, lowest_command=(20.0,) * twin.fans)
    return replace(twin, card=replace(twin.card, drive=drive))


def test_calibration_knows_top_speed_bend_drive_and_tachos_of_all_twins(
    plain: TrayTwin, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[dict[str, Any]] = []

    def seen(_runs: Any, top_speed_rad_s: float, *_: Any, sigma_shares: Any, **more: Any) -> None:
        given.append({"top": top_speed_rad_s, **more})

    monkeypatch.setattr(limits_of_twin, "calibrate", seen)
    faster = replace(plain, card=replace(plain.card, speed_range_rad_s=(0.0, 700.0)))
    counting = replace(plain, card=replace(plain.card, tacho=(Tacho(kind="count", window_s=0.5),)))
    for twins in ([plain], [with_a_drive(plain)], [with_a_drive(plain), faster], [plain, counting]):
        limits_of_twin.find_limits(twins, lambda _work: iter(()), Timing(), 1.0, alarms_left_out=2)
    bend_rad_s = plain.bend_rad_s
    assert bend_rad_s
    common = {"crossover_speed_rad_s": bend_rad_s, "sigma_rad_s": pytest.approx(plain.sigma_rad_s.mean())}
    common |= {"alarms_left_out": 2}
    assert given == [
        {"top": 500.0, "has_drive": False, "over_predicted_speed": False, **common},
        {"top": 500.0, "has_drive": True, "over_predicted_speed": False, **common},
        {"top": 700.0, "has_drive": False, "over_predicted_speed": False, **common},
        {"top": 500.0, "has_drive": False, "over_predicted_speed": True, **common},
    ]


def test_calibration_knows_the_sigma_of_each_fan_relative_to_its_full_speed(
    plain: TrayTwin, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[dict[str, Any]] = []
    monkeypatch.setattr(limits_of_twin, "calibrate", lambda *_, **more: given.append(more["sigma_shares"]))
    balance = replace(
        plain.balance,
        friction=np.array([0.0, 0.2]),
        viscous=np.array([0.002, 0.0]),
        drag=np.array([0.0, 0.8e-4]),
        sigma_command=np.array([0.01, 0.02]),
    )
    twin = replace(
        plain,
        card=replace(plain.card, command_range=(0.0, 1.0)),
        balance=balance,
        sigma_rad_s=np.array([5.0, 1.0]),
    )
    assert twin.full_speed_rad_s == pytest.approx([500.0, 100.0])
    without_drag = replace(balance, viscous=np.array([0.002, 0.0]), drag=np.zeros(2))
    assert replace(twin, balance=without_drag).full_speed_rad_s == pytest.approx([500.0, twin.card.top_speed_rad_s])
    for twins in ([twin], [twin, twin]):
        limits_of_twin.find_limits(twins, lambda _work: iter(()), Timing(), 1.0)
    assert given[0]["speed"] == pytest.approx([0.01, 0.01])
    assert given[0]["balance"].tolist() == [0.01, 0.02]
    assert given[1] == {}
