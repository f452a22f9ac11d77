"""4-pin fans, their faults, and the thermostat that commands them."""

from dataclasses import replace

import numpy as np
import pytest

from bench.detection.tray_run import run_of
from fantwin.schemas.tacho import Tacho
from fantwin.simulation.excitation import STEPS, Thermostat
from fantwin.simulation.faults import CLOG_S, four_pin_damage, parse_fault
from fantwin.simulation.four_pin import FourPinDamage, FourPinFans, FourPinParameters, four_pin_tray, wanted_speed_rad_s
from fantwin.simulation.tacho import TachoSettings
from fantwin.simulation.tray import TraySettings

FAN = FourPinParameters()
STEADY = {"sag": 0.0, "wander": 0.0, "air": 0.0}
STEP_S = 0.01


def course(duty: np.ndarray, damage: FourPinDamage | None = None, **parameters: float) -> np.ndarray:
    """(n,) speeds of one fan after each step of a course of duty (n,)."""
    one = replace(four_pin_tray(1, 0, 0.0), **{k: np.array([v]) for k, v in (STEADY | parameters).items()})
    fans = FourPinFans(one, np.random.default_rng(1), 1)
    fans.damage = damage or FourPinDamage()
    found = []
    for now in duty:
        fans.advance(np.array([now]), STEP_S)
        found.append(fans.speed_rad_s[0])
    return np.array(found)


def settled(duty: float, damage: FourPinDamage | None = None) -> float:
    return float(course(np.full(1500, duty), damage)[-1])


def test_the_curve_is_concave_with_a_plateau_and_stops_below_a_duty() -> None:
    duty = np.linspace(0.0, 1.0, 1001)
    speed = wanted_speed_rad_s(duty, FAN)
    off, plateau, curve = duty < FAN.duty_stop, (duty >= FAN.duty_stop) & (duty <= 0.2), duty > 0.2
    assert np.all(speed[off] == 0.0)
    assert np.ptp(speed[plateau]) == 0.0
    assert np.all(np.diff(speed[curve]) > 0.0)
    assert np.diff(speed[curve], n=2).max() < 1e-9
    # 3.3 of the specification: the share of the full speed is the duty within 10 %
    assert np.abs(speed[curve] / speed[-1] - duty[curve]).max() < 0.1
    assert [settled(d) for d in (0.05, 0.15, 0.6)] == pytest.approx(
        wanted_speed_rad_s(np.array([0.05, 0.15, 0.6]), FAN), rel=1e-3
    )


def test_a_start_has_a_pulse_of_its_duration_and_only_from_standstill() -> None:
    off, low = np.zeros(800), np.full(600, 0.1)
    speed = course(np.concatenate((low, off, low, off[:5], low)))
    first, second = speed[:600], speed[1400:2000]
    assert speed[1399] == 0.0
    assert np.array_equal(first, second)
    assert np.argmax(first) == round(float(FAN.kick_s) / STEP_S) - 1
    assert 0.2 < first.max() / FAN.speed_max_rad_s < 0.3  # 3.2 of the specification
    assert speed[2005:].max() < 1.001 * FAN.speed_min_rad_s  # it was still turning: no pulse


def test_a_fan_coasts_more_slowly_than_it_runs_up() -> None:
    high, low = np.full(1000, 1.0), np.full(1200, 0.3)
    speed = course(np.concatenate((high, low, high)))
    settled_low, settled_high = speed[2199], speed[999]
    level = settled_low + (settled_high - settled_low) * np.exp(-1.0)
    assert np.argmax(speed[1000:2200] <= level) * STEP_S == pytest.approx(FAN.down_s, abs=0.03)
    level = settled_high - (settled_high - settled_low) * np.exp(-1.0)
    assert np.argmax(speed[2200:] >= level) * STEP_S == pytest.approx(FAN.up_s, abs=0.03)


def test_the_supply_gives_way_to_the_load_of_the_fans_that_share_it_and_the_speed_wanders() -> None:
    four = replace(four_pin_tray(4, 0, 0.0), wander=np.zeros(4), air=np.zeros(4))
    fans = FourPinFans(four, np.random.default_rng(1), 2)
    for _ in range(300):
        fans.advance(np.array([1.0, 1.0, 1.0, 0.0]), 0.1)
    share = fans.speed_rad_s / FAN.speed_max_rad_s
    assert share[:2] == pytest.approx(1.0 - 0.02 * share[0] ** 2)
    assert share[2] == pytest.approx(1.0 - 0.01 * share[2] ** 2)
    lone = FourPinFans(replace(four_pin_tray(400, 0, 0.0), air=np.zeros(400)), np.random.default_rng(1), 1)
    for _ in range(300):
        lone.advance(np.full(400, 0.6), 0.1)
    wandering = lone.speed_rad_s
    # through the lags of the fan the wandering is damped: tau_w / (tau_w + tau) of the variance
    assert 0.8 < wandering.std() / wandering.mean() / (0.003 * np.sqrt(3.0 / (3.0 + 1.05))) < 1.2


@pytest.mark.parametrize(
    ("duty", "held", "share"), [(0.6, 1.0, 1.0), (0.6, 0.0, 0.8), (1.0, 1.0, 0.88), (1.0, 0.0, 0.8)]
)
def test_a_fan_that_holds_its_speed_needs_no_more_supply_until_it_does_not_suffice(
    duty: float, held: float, share: float
) -> None:
    """A fan at 80 % of the nominal supply, with a reserve of 10 %."""
    steady = replace(four_pin_tray(1, 0, 0.0), sag=np.zeros(1), wander=np.zeros(1), air=np.zeros(1))
    speeds = []
    for supply_factor in (1.0, 0.8):
        fans = FourPinFans(steady, np.random.default_rng(1), 1)
        fans.supply_factor, fans.supply_held = supply_factor, held
        for _ in range(200):
            fans.advance(np.array([duty]), 0.1)
        speeds.append(fans.speed_rad_s[0])
    assert speeds[1] / speeds[0] == pytest.approx(share, rel=1e-3)


@pytest.mark.parametrize(
    ("text", "lost"),
    [("blade:fan=0,start=5", 0.10), ("bearing:fan=0,start=5", 0.03), ("clog:fan=0,start=5", 0.06)],
)
def test_a_slow_fault_takes_its_share_of_the_speed(text: str, lost: float) -> None:
    assert 1.0 - settled(0.6, damage_at(text, 5.0 + CLOG_S)) / settled(0.6) == pytest.approx(lost, rel=0.01)
    if text.startswith("clog"):
        assert 1.0 - settled(0.6, damage_at(text, 5.0 + CLOG_S / 3.0)) / settled(0.6) == pytest.approx(
            lost / 3.0, rel=0.01
        )


def damage_at(text: str, t_s: float) -> FourPinDamage:
    return four_pin_damage([parse_fault(text)], 1, t_s)


def test_a_worn_bearing_runs_up_more_slowly_and_coasts_shorter() -> None:
    worn = damage_at("bearing:fan=0", 1.0)
    duty = np.concatenate((np.full(800, 0.3), np.full(800, 1.0), np.full(800, 0.3)))
    well, ill = course(duty), course(duty, worn)
    halfway = [np.argmax(s[800:1600] > (s[799] + s[1599]) / 2) * STEP_S for s in (well, ill)]
    assert halfway[1] / halfway[0] == pytest.approx(1.8, rel=0.03)
    halfway = [np.argmax(s[1600:] < (s[1599] + s[-1]) / 2) * STEP_S for s in (well, ill)]
    assert halfway[1] / halfway[0] == pytest.approx(0.75, rel=0.03)


RACK = TraySettings(
    fans=4,
    fan="4-pin",
    rate_hz=10.0,
    duration_s=60.0,
    profile="thermostat",
    tacho=TachoSettings((Tacho(kind="count", window_s=0.5),)),
)


def test_a_tray_shows_a_blocked_rotor_no_power_and_a_loose_wire_of_their_fans_alone() -> None:
    texts = (
        "blocked:fan=0,start=20,stop=40",
        "no-power:fan=1,start=20,stop=40",
        "tacho-dropout:fan=2,start=20,size=0.35",
    )
    healthy, speed = (
        run_of(each, 0.6).speed_rad_s for each in (RACK, replace(RACK, faults=tuple(map(parse_fault, texts))))
    )
    assert np.array_equal(speed[:200], healthy[:200])
    assert np.array_equal(speed[:, 3], healthy[:, 3]) is False  # the load on the supply is another
    assert np.all(speed[215:400, 0] == 0.0)  # a window and the braking later
    assert 0.0 < speed[215, 1] < 0.5 * healthy[215, 1]  # it coasts
    assert np.all(speed[300:400, 1] == 0.0)
    assert np.isnan(speed[200:, 2]).mean() == pytest.approx(0.35, abs=0.08)
    assert speed[500:, :2] == pytest.approx(healthy[500:, :2], rel=0.06)


def test_a_thermostat_stops_starts_and_moves_in_steps_of_its_register() -> None:
    profile = Thermostat(4, seed=2, low=0.1, high=0.95, period_s=4 * 3600.0)
    duty = np.array([profile.command(float(k)) for k in range(4 * 3600)])
    assert np.allclose(duty * STEPS, np.round(duty * STEPS))
    running = duty[duty > 0.0]
    assert running.min() >= 0.1 - 0.5 / STEPS
    assert running.max() > 0.8
    stops = (duty[1:] == 0.0) & (duty[:-1] > 0.0)
    assert np.all(stops.sum(axis=0) >= 4)
    assert np.all(stops.sum(axis=0) <= 40)  # the limits of stop and start keep it from chattering
    assert 0.05 < (duty == 0.0).mean() < 0.3
    assert np.corrcoef(duty[:, 0], duty[:, 1])[0, 1] > 0.95  # one zone
    assert np.corrcoef(duty[:, 0], duty[:, 2])[0, 1] < 0.6
    assert np.array_equal(profile.command(4 * 3600.0), profile.command(0.0))
