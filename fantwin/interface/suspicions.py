"""Tables whose units are certainly not those that they are said to be are refused, for their numbers would look like
those of faults; where they may be wrong, it is said."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fantwin.interface.tables import NAME, Array, FanTable
from fantwin.interface.words import warn
from fantwin.pipeline.errors import FantwinError
from fantwin.pipeline.prediction.tray_twin import Balance, TrayTwin
from fantwin.pipeline.sources.tables.measured_table import Table
from fantwin.pipeline.sources.tables.units import RAD_S_PER_TABLE_UNIT
from fantwin.schemas.messages import Score
from fantwin.schemas.twin_card import TwinCard

SLOWEST, FASTEST = 100.0, 1e-3
"""most and least time between samples, relative to that of training: between them, a table is resampled"""
SMALLEST_COMMAND = 0.02
"""share of the highest command of training that the commands of a table must reach, unless all are 0"""
LARGEST_COMMAND = 10.0
"""the same, that they may not reach"""
FASTEST_FAN = 3.0
"""speed relative to the highest of training that a tenth of the readings may exceed"""
NEAR_UNIT, NEAR_UNIT_BY_BALANCE = 0.05, 0.25
"""a speed that differs from the prediction by the ratio of two units, to within this share, is in the other unit; the
second of the speed at which a fan settles"""
LARGE_FACTOR = 1.5
"""of the speeds of all fans to their predictions, or of predictions to speeds: units may be wrong"""
STANDS = 0.02
"""share of the predicted speed below which a fan does not turn"""
RARE, DENSE = 2.0, 0.2
"""time between samples, relative to that of training, from which a table has much fewer or more samples"""


def suspect_times(samples: Table, twin: TrayTwin) -> None:
    """Compare the time between samples with that of the twin.

    Raises:
        FantwinError: the times are in another unit.

    Warns:
        FantwinWarning: fans settle unseen between two samples, or most samples are left out; the unit may be wrong.
    """
    card = twin.card
    period_s = samples.median_period_s
    if not FASTEST <= period_s * card.rate_hz <= SLOWEST:
        raise FantwinError(
            f"{NAME} has a sample every {period_s:.3g} s, and the twin was trained on one every "
            f'{1.0 / card.rate_hz:.3g} s: give the unit of its times, fantwin.Columns(time="NAME:ms"), or use a '
            "twin of such samples"
        )
    periods, give = period_s * card.rate_hz, "if that is wrong, give the unit of the times"
    settling_s = _time_constant_s(twin)
    if periods > RARE and period_s > settling_s:
        warn(
            [
                f"{NAME} has a sample every {period_s:.3g} s, and its fans settle in {settling_s:.2g} s: what they do "
                f"in between is interpolated, and the twin cannot be compared with it; {give}"
            ]
        )
    elif periods < DENSE:
        warn(
            [
                f"{NAME} has a sample every {period_s:.3g} s, and the twin one every {1.0 / card.rate_hz:.3g} s: of "
                f"{len(samples.t_ns)} times {int(len(samples.t_ns) * periods) + 1} remain; {give}"
            ]
        )


def _time_constant_s(twin: TrayTwin) -> float:
    """Time constant of the slowest fan at half its speed, by the torque balance; infinite where that has none."""
    balance = twin.balance
    slope = balance.viscous + balance.drag * twin.card.top_speed_rad_s
    known = (slope > 0.0) & (balance.inertia > 0.0)
    return float(np.max(balance.inertia[known] / slope[known])) if known.any() else np.inf


def refuse_commands(samples: Table, card: TwinCard) -> None:
    """Raise FantwinError for commands in another unit."""
    highest, trained = float(np.abs(samples.command).max()), max(map(abs, card.command_range))
    if highest == 0.0 or SMALLEST_COMMAND * trained < highest < LARGEST_COMMAND * trained:
        return
    unit = f" {card.command_unit}" if card.command_unit else ""
    raise FantwinError(
        f"{NAME} has commands up to {highest:.3g}, and the twin was trained on commands up to {trained:.3g}{unit}: "
        "convert them to its unit"
    )


def refuse_high_speeds(samples: Table, card: TwinCard) -> None:
    """Raise FantwinError for speeds in a smaller unit than they are said to be in."""
    known = np.abs(samples.speed_rad_s[np.isfinite(samples.speed_rad_s)])
    high, trained = float(np.quantile(known, 0.9)) if len(known) else 0.0, card.top_speed_rad_s
    if high > FASTEST_FAN * trained:
        rad_s = RAD_S_PER_TABLE_UNIT[samples.speed_unit]
        raise FantwinError(
            f"{NAME} has speeds of {high / rad_s:.3g} {samples.speed_unit}, and the fans of the twin reach "
            f'{trained / rad_s:.3g}: give their unit, such as fantwin.Columns(speed="NAME:rpm")'
        )


def suspect_levels(given: FanTable, twin: TrayTwin, scores: Sequence[Score]) -> None:
    """Compare the levels of the speeds of all fans with those that their commands predict.

    Where a free run does not start from a speed, its torque balance says at which speed a fan settles.

    Raises:
        FantwinError: they differ by the ratio of two units, have the other sign, or are the commands.

    Warns:
        FantwinWarning: they differ by another large factor, that of a command's unit or of a tacho's pulses perhaps.
    """
    samples, settled = given.samples, _settled_rad_s(twin.balance, given.samples.command)
    of_run = _factors(*(_joined(scores, name) for name in ("measured_speed_rad_s", "predicted_speed_rad_s")))
    rough = _factors(samples.speed_rad_s, settled)
    factors = np.where(np.isfinite(of_run), of_run, rough)
    factors = factors[np.isfinite(factors)]
    if not len(factors):
        return
    _refuse_swapped(given, twin.card)
    if (factors < -1.0 / LARGE_FACTOR).all():
        raise FantwinError(f"{NAME} has speeds below zero where the twin predicts speeds above: turn their sign")
    for other, rad_s in RAD_S_PER_TABLE_UNIT.items():
        ratio = RAD_S_PER_TABLE_UNIT[samples.speed_unit] / rad_s
        near = NEAR_UNIT if np.isfinite(of_run).any() else NEAR_UNIT_BY_BALANCE
        if ratio != 1.0 and (np.abs(factors / ratio - 1.0) < near).all():
            raise FantwinError(
                f"{NAME} has speeds in {other}, not in {samples.speed_unit}: they are {ratio:.3g} times what the twin "
                f'predicts; say so: fantwin.Columns(speed="NAME:{other}")'
            )
    usual = float(np.median(factors))
    if usual > STANDS and ((factors > LARGE_FACTOR).all() or (factors < 1.0 / LARGE_FACTOR).all()):
        unit = f" ({twin.card.command_unit})" if twin.card.command_unit else ""
        low, high = twin.card.command_range
        warn(
            [
                f"{NAME}: the speeds are {usual:.2g} times what the twin predicts by the commands, "
                f"{_span(samples.command)}; it was trained on {low:.3g} to {high:.3g}{unit}: check the unit of the "
                "commands, and the unit of the speeds or the pulses a revolution of the tacho"
            ]
        )


def _joined(scores: Sequence[Score], name: str) -> Array:
    return np.concatenate([getattr(score, name) for score in scores])


def _settled_rad_s(balance: Balance, command: Array) -> Array:
    """(n, fans) the speed at which each fan settles by the torque balance; NaN where it does not turn."""
    drive, viscous, drag = command - balance.friction, balance.viscous, balance.drag
    with np.errstate(invalid="ignore", divide="ignore"):
        speed: Array = 2.0 * drive / (viscous + np.sqrt(np.square(viscous) + 4.0 * drag * drive))
    return np.where((drive > 0.0) & (speed > 1.0), speed, np.nan)


def _factors(measured: Array, predicted: Array) -> Array:
    """(fans,) the median speed relative to that which is predicted; NaN where most samples have none."""
    known = np.isfinite(measured) & (predicted > 1.0)
    return np.array(
        [
            np.median(measured[rows, fan]) / np.median(predicted[rows, fan]) if 2 * rows.sum() > len(rows) else np.nan
            for fan, rows in enumerate(known.T)
        ]
    )


def _refuse_swapped(given: FanTable, card: TwinCard) -> None:
    """Raise FantwinError where the commands are as speeds, and the speeds as commands."""
    samples, (low, high) = given.samples, card.command_range
    in_unit = RAD_S_PER_TABLE_UNIT[samples.speed_unit]
    speeds, commands = samples.speed_rad_s / in_unit, samples.command
    speeds = speeds[np.isfinite(speeds)]
    if np.median(commands) > 1.5 * high and low <= np.median(speeds) <= high < card.top_speed_rad_s / in_unit:
        raise FantwinError(
            f"{NAME} has commands of {_span(commands)} and speeds of {_span(speeds)} {samples.speed_unit}, and the "
            f"twin was trained on commands up to {high:.3g}: are the two columns swapped?"
        )


def _span(values: Any) -> str:
    return f"{np.nanmin(values):.3g} to {np.nanmax(values):.3g}"
