"""twin.reference: runs at other supply voltages and temperatures teach the same twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.detection.tray_run import run_of
from fantwin.schemas.reference_conditions import ReferenceConditions
from fantwin.simulation.plant import Surroundings
from fantwin.simulation.tacho import NoisyTacho, TachoSettings
from fantwin.simulation.tray import TraySettings
from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.errors import TwinError
from fantwin.twin.fitting.drive_fit import FoundDrive
from fantwin.twin.fitting.identification import identify
from fantwin.twin.fitting.reference_choice import identify_at_reference
from fantwin.twin.models.drive import Drive
from fantwin.twin.reference import at_reference, reference_of
from fantwin.twin.runs import Run

NOISE_RAD_S = 2.0


def simulated(seed: int, surroundings: Surroundings, seconds: float = 60.0) -> Run:
    """A run of one fan under a wandering supply and air."""
    tacho = TachoSettings(noise=NoisyTacho(NOISE_RAD_S))
    settings = TraySettings(
        fans=1, rate_hz=50.0, duration_s=seconds, profile="prbs", seed=seed, tacho=tacho, surroundings=surroundings
    )
    return run_of(settings)


MEASURED = Surroundings(
    supply_wander=0.05,
    temperature_swing_c=10.0,
    temperature_period_s=60.0,
    measured=("supply_voltage_v", "temperature_c"),
)


@pytest.fixture(scope="module")
def runs() -> tuple[Run, Run]:
    """One to train on, one held out."""
    return simulated(1, MEASURED), simulated(2, MEASURED)


def test_a_twin_that_knows_supply_and_air_is_exact_where_they_wander(runs: tuple[Run, Run]) -> None:
    training, held_out = runs
    twin = train_twin([training], [], "physical", name="knows")
    blind = train_twin([replace(training, auxiliary={})], [], "physical", name="blind")
    conditions = twin.card.conditions
    assert conditions is not None and conditions.needed == ("supply_voltage_v", "temperature_c")
    assert conditions.supply_voltage_v == pytest.approx(12.0, rel=0.06)
    assert blind.card.conditions is None
    known, unknown = (evaluate(each, [held_out]).pooled.rmse_rad_s for each in (twin, blind))
    assert known < 2.0 * NOISE_RAD_S
    assert unknown > 3.0 * known


def test_only_what_all_runs_know_nearly_throughout_is_used(runs: tuple[Run, Run]) -> None:
    one, other = runs
    assert reference_of([one, replace(other, auxiliary={})]) is None
    patchy = other.auxiliary["temperature_c"].copy()
    patchy[: len(patchy) // 4] = np.nan
    patchy_run = replace(other, auxiliary={**other.auxiliary, "temperature_c": patchy})
    found = reference_of([one, patchy_run])
    assert found is not None and found.needed == ("supply_voltage_v",)
    sparse = np.full_like(patchy, np.nan)
    sparse[::50] = 20.0  # once a second
    found = reference_of([replace(other, auxiliary={"temperature_c": sparse})])
    assert found is not None and found.needed == ("temperature_c",)
    with pytest.raises(TwinError, match="has no supply_voltage_v, which the twin needs"):
        at_reference([replace(one, auxiliary={})], ReferenceConditions(supply_voltage_v=12.0))


def test_a_column_that_the_fans_do_not_follow_is_left_out(runs: tuple[Run, Run]) -> None:
    """A fan that makes up for its supply, or a bad sensor."""
    volts = runs[0].auxiliary["supply_voltage_v"]
    strange = replace(runs[0], auxiliary={**runs[0].auxiliary, "supply_voltage_v": volts[::-1].copy()})
    left_out = identify_at_reference([strange])
    assert left_out.conditions is not None
    assert left_out.conditions.needed == ("temperature_c",)
    (note,) = left_out.notes
    assert note.startswith("supply voltage: not used, because the fans do not follow it")
    by_air = identify(at_reference([strange], left_out.conditions))
    np.testing.assert_array_equal(left_out.identification.parameters, by_air.parameters)


def test_a_twin_behind_a_drive_allows_for_nothing_and_says_so(
    runs: tuple[Run, Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = FoundDrive(Drive(0.01, 0.3, 1.0), np.array([[0.02, 0.0, 0.5]]))
    monkeypatch.setattr("fantwin.twin.build.find_drive", lambda *_: drive)
    twin = train_twin([runs[0]], [], "physical", name="drive")
    assert twin.card.conditions is None
    said = "supply voltage and temperature: not used, because these fans control their own speed"
    assert said in twin.identification.warnings
