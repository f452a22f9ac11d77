"""scoring.wear, through the scorer of a tray whose twins are learned: wear goes on when a retrained twin takes over.

As in test_wear_monitor, 15 s are measured in each hour, and the friction of one of two fans grows by the same amount
every day. In the middle of the time a twin takes over that was trained on the worn fan.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.config.loading import load_config
from pipeline.runtime.stage import Context, load_stage
from pipeline.runtime.tray_twin import load_tray_twin
from schemas.enums import Action
from schemas.messages import Alarm, Message, ModelCard, ScorerSnapshot
from scoring.diagnosis.regression_window import HealthyBalance
from tests.scoring.wear.test_wear_monitor import DAY_NS, GROWTH_PER_DAY, HEALTHY, WORN, burst
from tests.support.scored_blocks import (
    CALIBRATION,
    EPOCH_NS,
    SIGMA_COMMAND,
    TWIN_SPEED,
    balance_of_a_fan,
    core_of,
    request_of,
    snapshot_of,
)
from tests.support.twin_files import write_twin

TAKEOVER_DAY, DAYS = 4.0, 8.0
TAKEOVER_NS = EPOCH_NS + round(TAKEOVER_DAY * DAY_NS)
ABSORBED = GROWTH_PER_DAY * TAKEOVER_DAY
"""friction that the retrained twin takes for healthy"""
OF_REFERENCE = ("drag", "friction", "gain")
"""the parameters that refer to the first twin"""
NEEDED_FOR_DRAG = balance_of_a_fan().drag * TWIN_SPEED**2
TRUTH_PER_DAY = {
    "friction": GROWTH_PER_DAY,
    "drag": GROWTH_PER_DAY / NEEDED_FOR_DRAG,
    "gain": -GROWTH_PER_DAY / 50.0,
}
"""growth of the worn fan, by each parameter alone"""
CONFIGURATION = """
[[tray]]
name = "tray1"
fans = 2
command_max = 100.0
[scorer]
baseline_s = 3.0
"""


@dataclass
class Twin:
    """A learned twin: the message that brings it, and the torque balance of each fan by it."""

    card: ModelCard
    balances: Sequence[HealthyBalance]


def twin_of(path: Path, balances: Sequence[HealthyBalance], more_expected: float = 0.0) -> Twin:
    """A twin with these torque balances, calibrated with the first fan without wear: what its balance lacks is expected
    at each speed. more_expected: by how much that is wrong."""
    speed_rad_s = TWIN_SPEED * np.linspace(0.9, 1.1, 5)
    lacking = needed_by(balance_of_a_fan(), speed_rad_s) - needed_by(balances[0], speed_rad_s)
    expected = {
        "speeds_rad_s": speed_rad_s.tolist(),
        "expected_residual_sigmas": ((lacking + more_expected) / SIGMA_COMMAND).tolist(),
        "residual_std": [1.0] * len(speed_rad_s),
    }
    numbers = [name for name in vars(balances[0]) if name not in ("covariance", "filter_rate_per_s")]
    balance = {
        **{name: [getattr(fan, name) for fan in balances] for name in numbers},
        "covariance": [fan.covariance.tolist() for fan in balances],
        "filter_rate_per_s": balances[0].filter_rate_per_s,
        "source": ["physics"] * len(balances),
    }
    calibration = {**CALIBRATION, "balance": expected}
    write_twin(path, fans=len(balances), name=path.stem, calibration=calibration, balance=balance)
    twin = load_tray_twin(path)
    card = ModelCard(
        t_ns=EPOCH_NS,
        twin=path.stem,
        kind=twin.card.kind,
        sha256=twin.sha256,
        sigma_rad_s=twin.sigma_rad_s,
        card_json=twin.card_json,
        content=path.read_bytes(),
    )
    return Twin(card, balances)


def needed_by(fan: HealthyBalance, speed_rad_s: Any) -> Any:
    return fan.viscous * speed_rad_s + fan.drag * speed_rad_s**2 + fan.friction


def first_twin(folder: Path) -> Twin:
    """Of the fans without wear; its drag is 2 % too small."""
    fan = balance_of_a_fan()
    return twin_of(folder / "tray1-1.onnx", [replace(fan, drag=0.98 * fan.drag)] * 2)


def retrained_twin(folder: Path, absorbed: float) -> Twin:
    """With other coefficients for the same torque, and more friction of the fan that wears."""
    fan = balance_of_a_fan()
    other = replace(fan, inertia=1.1 * fan.inertia, drag=0.9 * fan.drag, friction=fan.friction + 0.1 * NEEDED_FOR_DRAG)
    return twin_of(folder / "tray1-2.onnx", [other, replace(other, friction=other.friction + absorbed)])


class Tray:
    """A tray of two fans whose twins are learned, and its scorer."""

    def __init__(self, folder: Path, growth_per_day: float) -> None:
        (folder / "site.toml").write_text(CONFIGURATION)
        self.folder = folder
        self._config = load_config(folder / "site.toml")
        self._growth_per_day = growth_per_day
        self.emitted: list[Message] = []
        self.start()

    def start(self) -> None:
        """Start the scorer; it finds the snapshot of the one before it."""
        context = Context(
            site="plant",
            trays=self._config.trays,
            config=self._config.sections["scorer"],
            folder=self.folder,
            run_folder=self.folder,
            started_t_ns=0,
            snapshot_folder=self.folder,
        )
        self.core: Any = load_stage("scorer").build(context).core

    def live(self, twin: Twin, from_day: float, days: float) -> None:
        """Let a twin be in force from one day to another."""
        self.emitted += self.core.step(twin.card)
        for hour in np.arange(from_day * 24, days * 24).tolist():
            block = burst(hour, self._growth_per_day, swing=0.0, by=twin.balances, twin=twin.card.twin)
            self.emitted += self.core.step(block)

    def stop(self) -> ScorerSnapshot:
        """Stop the scorer; returns its last snapshot."""
        self.emitted += self.core.close()
        return [message for message in self.emitted if isinstance(message, ScorerSnapshot)][-1]


@pytest.fixture(scope="module")
def worn(tmp_path_factory: pytest.TempPathFactory) -> Tray:
    """A tray after eight days; the scorer has stopped."""
    return after_takeover(tmp_path_factory.mktemp("worn"), GROWTH_PER_DAY, ABSORBED)


def after_takeover(folder: Path, growth_per_day: float, absorbed: float) -> Tray:
    tray = Tray(folder, growth_per_day)
    tray.live(first_twin(folder), 0.0, TAKEOVER_DAY)
    tray.live(retrained_twin(folder, absorbed), TAKEOVER_DAY, DAYS)
    tray.stop()
    return tray


def last_snapshot(tray: Tray) -> ScorerSnapshot:
    return [message for message in tray.emitted if isinstance(message, ScorerSnapshot)][-1]


def wear_of(snapshot: ScorerSnapshot, fan: int) -> Any:
    return json.loads(snapshot.state_json)["wear"]["fans"][fan]


def step_in_errors(parameter: Any, per_day: float) -> float:
    """By how much the points change at the takeover, apart from this growth, in standard errors."""
    series = parameter["series"]
    t_ns, value, std_error = (np.array(series[name]) for name in ("t_ns", "value", "std_error"))
    rest, after = value - per_day * (t_ns - EPOCH_NS) / DAY_NS, t_ns > TAKEOVER_NS
    assert after.sum() > 30 and (~after).sum() > 30
    error = np.hypot(*(np.sqrt(np.square(std_error[side]).sum()) / side.sum() for side in (after, ~after)))
    return float((rest[after].mean() - rest[~after].mean()) / error)


def test_wear_goes_on_in_one_line_with_a_twin_that_has_absorbed_it(worn: Tray) -> None:
    assert not [message for message in worn.emitted if isinstance(message, Alarm)]
    found = wear_of(last_snapshot(worn), WORN)["parameters"]
    friction = found["friction"]
    assert abs(step_in_errors(friction, GROWTH_PER_DAY)) < 1.0
    assert friction["per_day"]["low"] < GROWTH_PER_DAY < friction["per_day"]["high"]
    for parameter in OF_REFERENCE:
        assert found[parameter]["days"] > 7.5, parameter
        assert found[parameter]["per_day"]["value"] == pytest.approx(TRUTH_PER_DAY[parameter], rel=0.1), parameter
        assert found[parameter]["change"] == pytest.approx(DAYS * TRUTH_PER_DAY[parameter], rel=0.1), parameter
    for parameter in OF_REFERENCE:
        per_day = wear_of(last_snapshot(worn), HEALTHY)["parameters"][parameter]["per_day"]
        assert per_day["low"] < 0.0 < per_day["high"], parameter


def test_the_balance_starts_again_because_its_limit_is_of_the_present_twin(worn: Tray) -> None:
    balance = wear_of(last_snapshot(worn), WORN)["parameters"]["balance"]
    assert min(balance["series"]["t_ns"]) > TAKEOVER_NS
    assert balance["per_day"]["value"] == pytest.approx(GROWTH_PER_DAY, rel=0.1)
    assert balance["change"] == pytest.approx((DAYS - TAKEOVER_DAY) * GROWTH_PER_DAY, rel=0.1)
    assert balance["limit"] == pytest.approx(1.5 * SIGMA_COMMAND)


@pytest.fixture
def stopped(worn: Tray, tmp_path: Path) -> Tray:
    """A copy of the worn tray, to be started again."""
    shutil.copytree(worn.folder, tmp_path, dirs_exist_ok=True)
    return Tray(tmp_path, GROWTH_PER_DAY)


def last_friction(tray: Tray, fan: int) -> float:
    """The newest point of the series, which was taken since DAYS. A stored point is the mean of two."""
    of_fan = wear_of(last_snapshot(tray), fan)
    assert of_fan["t_ns"] > EPOCH_NS + DAYS * DAY_NS
    return of_fan["parameters"]["friction"]["series"]["value"][-1]


def test_wear_goes_on_if_a_twin_took_over_while_the_scorer_did_not_run(stopped: Tray) -> None:
    twin = twin_of(stopped.folder / "tray1-3.onnx", [balance_of_a_fan()] * 2)
    stopped.live(twin, DAYS, DAYS + 1 / 24)
    assert stopped.core.counters()["snapshots_of_another_twin"] == 1
    assert "baselines and alarms start from the beginning, wear continues" in stopped.core.problem()
    stopped.live(twin, DAYS + 1 / 24, DAYS + 0.25)
    stopped.stop()
    assert last_friction(stopped, WORN) == pytest.approx(DAYS * GROWTH_PER_DAY, rel=0.05)


def test_a_fan_that_is_commissioned_again_refers_to_the_present_twin(stopped: Tray) -> None:
    twin = retrained_twin(stopped.folder, ABSORBED)
    stopped.live(twin, DAYS, DAYS + 1 / 24)
    stopped.emitted += stopped.core.step(request_of(Action.COMMISSION, WORN))
    stopped.live(twin, DAYS + 1 / 24, DAYS + 0.5)
    snapshot = stopped.stop()
    assert min(wear_of(snapshot, WORN)["parameters"]["friction"]["series"]["t_ns"]) > EPOCH_NS + DAYS * DAY_NS
    assert last_friction(stopped, WORN) == pytest.approx(0.0, abs=0.04)
    assert not wear_of(snapshot, WORN)["reference"]["of_earlier_twin"]
    assert wear_of(snapshot, HEALTHY)["reference"]["of_earlier_twin"]


def test_wear_starts_again_with_another_twin_of_the_configuration(worn: Tray) -> None:
    """Whoever names it may have replaced the fans."""
    core = core_of(2, calibration=CALIBRATION, sha256="another")
    core.restore(last_snapshot(worn))
    assert wear_of(snapshot_of(core), WORN)["parameters"]["friction"]["series"]["t_ns"] == []
