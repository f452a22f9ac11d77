"""Every bench can be imported: what it takes from the product and from the tests is there."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.model.bins import Bins, bin_ns_of
from fantwin.scoring.model.decision import Decision
from fantwin.scoring.model.population import Priors
from tests.support.healthy_running import TOP_RAD_S, made_fans, running

ROOT = Path(__file__).parents[2]
OURS = ("bench", "fantwin", "tests")


def test_every_bench_finds_what_it_imports(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    for path in sorted((ROOT / "bench").rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            missing = str(error.name).partition(".")[0]
            assert missing not in OURS, f"{name}: {error}"  # others are packages of the extra `bench`


def test_what_the_ablation_leaves_out_exists_and_an_unknown_name_is_refused() -> None:
    without = importlib.import_module("bench.detection.without")
    for mechanism in importlib.import_module("bench.detection.mechanisms").MECHANISMS:
        for place, _ in mechanism.replaced:
            owner, attribute = without.owner_of(place)
            assert attribute in vars(owner), place
    with pytest.raises(without.UnknownMechanismError, match="--without list"), without.without("no-such"):
        pass


@pytest.mark.parametrize("name", [one.name for one in importlib.import_module("bench.detection.mechanisms").MECHANISMS])
def test_without_any_one_part_a_fan_that_loses_a_fifth_of_its_speed_has_an_alarm(name: str) -> None:
    block = running(2, 16.0, seed=1)
    slower = np.where(np.arange(160)[:, np.newaxis] < 80, 1.0, [0.8, 1.0]) * block.measured_speed_rad_s
    fans, bin_ns = made_fans(2), bin_ns_of(block.period_ns, 0.0)
    with importlib.import_module("bench.detection.without").without(name):
        decision = Decision(fans, bin_ns, block.period_ns / NS_PER_S, 86_400.0, Priors())
        for one in Bins(bin_ns, np.full(2, TOP_RAD_S), np.ones(2, np.bool_), None).take(
            replace(block, measured_speed_rad_s=slower)
        ):
            decision.take(one)
    assert decision.active.tolist() == [True, False]
