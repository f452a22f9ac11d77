"""A simulated tray: fans, tachos, a device clock and a command profile, which give one sample after the other.

The command of a sample applies from that sample to the next, as on a real device that sets its outputs when it
measures; so do the faults. Nothing here uses the wall clock: a serial line sends the samples in real time, a recording
takes them as fast as they are computed, and the same seed gives both the same samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fantwin.schemas.device_sample import DeviceSample
from fantwin.simulation.errors import SimulationError
from fantwin.simulation.excitation import excitation
from fantwin.simulation.fans import DcFans, FanKind, Fans, FourPinTray
from fantwin.simulation.faults import Fault, check_schedule, tacho_faults
from fantwin.simulation.four_pin import four_pin_tray
from fantwin.simulation.plant import Array, DeviceClock, Surroundings, SurroundingsNow, tray_of_fans
from fantwin.simulation.tacho import TachoSettings, simulated_tacho

MAX_FANS = 64
MAX_JITTER_PERIODS = 0.4
# Speed loop of a fan with a set-point, in duty per rad/s and duty per rad. A fan reaches about 900 rad/s at full duty
# with a time constant of about 1 s. The zero of the controller cancels it; the closed loop is about four times as fast.
LOOP_GAIN = 4e-3
LOOP_INTEGRAL_GAIN_PER_S = 4e-3


@dataclass(frozen=True)
class TraySettings:
    """Settings of a simulated tray."""

    fans: int = 8
    fan: FanKind = "dc"
    rate_hz: float = 100.0
    duration_s: float = math.inf
    profile: str = "manual"
    seed: int = 1
    """of commands, noise, jitter and losses"""
    fans_seed: int = 1
    """of the variation between fans"""
    fan_variation: float = 0.03
    """relative standard deviation of the fans' parameters"""
    lost: float = 0.0
    """share of samples that are lost"""
    jitter_us: float = 100.0
    """standard deviation of the time of sampling, cut at 0.4 periods"""
    tacho: TachoSettings = TachoSettings()
    clock: DeviceClock = DeviceClock()
    faults: tuple[Fault, ...] = ()
    surroundings: Surroundings = Surroundings()


class SimulatedTray:
    """Gives samples: `due_s` says when the next one is measured, `take` measures it.

    Raises:
        SimulationError: a setting is out of its range.
    """

    def __init__(self, settings: TraySettings) -> None:
        _check(settings)
        self.settings = settings
        self.fans = settings.fans
        profile, *others = np.random.SeedSequence(settings.seed).generate_state(6).tolist()
        self._excitation = excitation(settings.profile, settings.fans, profile)
        self._jitter_rng, self._loss_rng, tacho, self._dropout_rng = map(np.random.default_rng, others[:4])
        self._plant = _fans(settings, np.random.default_rng(others[4]))
        self.parameters = self._plant.parameters
        surroundings_rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(1,)))
        self._surroundings = SurroundingsNow(settings.surroundings, surroundings_rng)
        self._tacho = simulated_tacho(settings.tacho, settings.fans, tacho)
        self._command = np.zeros(settings.fans)
        self._override = np.full(settings.fans, np.nan)
        self._set_point_rad_s = np.full(settings.fans, np.nan)
        self._integral = np.zeros(settings.fans)
        self._reading_rad_s = np.zeros(settings.fans)
        self._count = 0
        self._t_s = 0.0
        self._started_s: dict[int, float] = {}
        self._stopped_s: dict[int, float] = {}
        self._due_s = self._next_due_s()

    def due_s(self) -> float | None:
        """Time of the next sample, s since the start; None after the last."""
        return self._due_s if self._count / self.settings.rate_hz < self.settings.duration_s else None

    def take(self) -> DeviceSample:
        """Advance the fans to the next sample and measure it."""
        t_s, step_s = self._due_s, self._due_s - self._t_s
        self._turn(t_s, step_s)
        speed_rad_s = self._measure(t_s)
        self._command = self._next_duty(t_s, speed_rad_s, step_s)
        self._plant.set_faults(self.settings.faults, t_s)
        auxiliary = self._surround(t_s)
        self._record_faults(t_s)
        sample = DeviceSample(
            t_s,
            self.settings.clock.at(t_s),
            self._count % 2**32,
            self._command,
            speed_rad_s,
            auxiliary,
            lost=bool(self._loss_rng.random() < self.settings.lost),
        )
        self._count += 1
        self._due_s = self._next_due_s()
        return sample

    def command(self, values: Array) -> None:
        """Override the profile and the speed loop: values (fans,) duty, NaN leaves a fan unchanged."""
        given = ~np.isnan(values)
        self._override = np.where(given, np.clip(values, 0.0, 1.0), self._override)
        self._set_point_rad_s = np.where(given, np.nan, self._set_point_rad_s)

    def release(self, fans: NDArray[np.bool_]) -> None:
        """Let the profile command these fans, (fans,), again."""
        self._override = np.where(fans, np.nan, self._override)

    def set_faults(self, faults: tuple[Fault, ...]) -> None:
        """The schedule from now on: that of the settings, with faults added at its end or ended.

        Raises:
            SimulationError: such fans have no such fault, or there is no such fan.
        """
        settings = self.settings
        check_schedule(faults, settings.fans, settings.duration_s, settings.fan)
        self.settings = replace(settings, faults=faults)

    def set_point(self, values_rad_s: Array) -> None:
        """Start the speed loop: values (fans,) rad/s, NaN leaves a fan unchanged."""
        given = ~np.isnan(values_rad_s)
        self._integral = np.where(given & np.isnan(self._set_point_rad_s), self._command, self._integral)
        self._set_point_rad_s = np.where(given, values_rad_s, self._set_point_rad_s)

    def happened(self, fault: int) -> tuple[float | None, float | None]:
        """When fault number `fault` of the settings began and ended, s since the start; None if it has not."""
        return self._started_s.get(fault), self._stopped_s.get(fault)

    @property
    def t_s(self) -> float:
        """Time of the last sample, s since the start."""
        return self._t_s

    def _next_due_s(self) -> float:
        period_s = 1.0 / self.settings.rate_hz
        limit_s = MAX_JITTER_PERIODS * period_s
        jitter_s = self._jitter_rng.normal() * self.settings.jitter_us * 1e-6
        return max(0.0, self._count * period_s + min(max(jitter_s, -limit_s), limit_s))

    def _turn(self, t_s: float, step_s: float) -> None:
        """Turn the fans until t_s, in pieces that are short enough for them and for their tachos."""
        pieces = max(1, math.ceil(step_s / min(self._plant.longest_step_s, self._tacho.longest_piece_s)))
        start_s, piece_s = self._t_s, step_s / pieces
        for piece in range(pieces):
            before = self._plant.speed_rad_s
            self._plant.advance(self._command, piece_s)
            piece_end_s = start_s + (piece + 1) * piece_s
            self._tacho.turn(start_s + piece * piece_s, before, piece_end_s, self._plant.speed_rad_s)
        self._t_s = t_s

    def _surround(self, t_s: float) -> dict[str, Array]:
        """Supply and air act from now on as they do at t_s; returns what is measured of them."""
        if self.settings.surroundings == Surroundings():
            return {}
        now = self._surroundings
        now.advance(t_s)
        return now.measure(*self._plant.surround(now.supply_factor, now.drag_factor))

    def _measure(self, t_s: float) -> Array:
        """(fans,) tacho readings. Faults do not change which random numbers are drawn."""
        stuck, dropout = tacho_faults(self.settings.faults, self.fans, t_s)
        self._reading_rad_s = np.where(stuck, self._reading_rad_s, self._tacho.read())
        missing = self._dropout_rng.random(self.fans) < np.maximum(dropout, self.settings.tacho.missing_readings)
        return np.where(missing, np.nan, self._reading_rad_s)

    def _next_duty(self, t_s: float, speed_rad_s: Array, step_s: float) -> Array:
        """(fans,) duty until the next sample: from a command, the speed loop, or else the profile."""
        duty = np.where(np.isnan(self._override), self._excitation.command(t_s), self._override)
        closed_loop = ~np.isnan(self._set_point_rad_s)
        if not closed_loop.any():
            return duty
        error_rad_s = np.nan_to_num(self._set_point_rad_s - speed_rad_s)  # without a reading the loop holds
        proportional = LOOP_GAIN * error_rad_s
        wanted = proportional + self._integral + LOOP_INTEGRAL_GAIN_PER_S * step_s * error_rad_s
        possible = np.clip(wanted, 0.0, 1.0)
        self._integral = possible - proportional  # anti-windup
        return np.where(closed_loop, possible, duty)

    def _record_faults(self, t_s: float) -> None:
        for number, fault in enumerate(self.settings.faults):
            if fault.active(t_s):
                self._started_s.setdefault(number, t_s)
            elif number in self._started_s:
                self._stopped_s.setdefault(number, t_s)


def _fans(settings: TraySettings, rng: np.random.Generator) -> Fans:
    of = settings.fans, settings.fans_seed, settings.fan_variation
    if settings.fan == "dc":
        return DcFans(tray_of_fans(*of))
    fans = FourPinTray(four_pin_tray(*of), rng, settings.fans)
    fans.supply_held = settings.surroundings.supply_held
    return fans


def _check(settings: TraySettings) -> None:
    limits = (
        ("fans", settings.fans, 1, MAX_FANS),
        ("rate", settings.rate_hz, 0.1, 10_000.0),
        ("duration", settings.duration_s, 0.0, math.inf),
        ("seed", settings.seed, 0, 2**63),
        ("fans seed", settings.fans_seed, 0, 2**63),
        ("lost", settings.lost, 0.0, 1.0),
        ("jitter", settings.jitter_us, 0.0, math.inf),
        ("drift", settings.clock.drift_ppm, -100_000.0, 100_000.0),
        ("clock start", settings.clock.start_us, 0, 2**32 - 1),
        ("tacho noise", settings.tacho.noise.noise_rad_s, 0.0, math.inf),
        ("missing edges", settings.tacho.missing_edges, 0.0, 1.0),
        ("double edges", settings.tacho.double_edges, 0.0, 1.0),
        ("supply wander", settings.surroundings.supply_wander, 0.0, 0.3),
        ("supply held", settings.surroundings.supply_held, 0.0, 1.0),
        ("air temperature", settings.surroundings.temperature_c, -50.0, 100.0),
        ("air swing", settings.surroundings.temperature_swing_c, 0.0, 50.0),
        ("missing readings", settings.tacho.missing_readings, 0.0, 1.0),
    )
    for name, value, smallest, largest in limits:
        if not smallest <= value <= largest:
            upto = f"to {largest:g}" if math.isfinite(largest) else "on"
            raise SimulationError(f"{name} = {value:g}; give one from {smallest:g} {upto}")
    if settings.fan != "dc" and "current_a" in settings.surroundings.measured:
        raise SimulationError(f"the current of {settings.fan} fans is not simulated: choose dc fans for it")
    check_schedule(settings.faults, settings.fans, settings.duration_s, settings.fan)
