"""Tables whose units are certainly not those that they are said to be: they are refused, for their numbers would look
like those of faults."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fantwin.interface.tables import NAME
from fantwin.pipeline.errors import FantwinError
from fantwin.pipeline.sources.tables.measured_table import RAD_S_PER_TABLE_UNIT, Table
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
NEAR_UNIT = 0.05
"""a speed that differs from the prediction by the ratio of two units, to within this share, is in the other unit"""


def refuse_times(samples: Table, card: TwinCard) -> None:
    """Raise FantwinError for times in another unit."""
    period_s = samples.median_period_s
    if not FASTEST <= period_s * card.rate_hz <= SLOWEST:
        raise FantwinError(
            f"{NAME} has a sample every {period_s:.3g} s, and the twin was trained on one every "
            f'{1.0 / card.rate_hz:.3g} s: give the unit of its times, fantwin.Columns(time="NAME:ms"), or use a '
            "twin of such samples"
        )


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


def refuse_speeds(scores: Sequence[Score], unit: str) -> None:
    """Raise FantwinError where all fans differ from their predictions as much as two units of speeds."""
    if not scores:
        return
    measured, predicted, valid = (
        np.concatenate([getattr(score, name) for score in scores])
        for name in ("measured_speed_rad_s", "predicted_speed_rad_s", "valid")
    )
    share = np.divide(measured, predicted, out=np.full(valid.shape, np.nan), where=valid & (predicted > 1.0))
    of_fans = [float(np.nanmedian(fan)) for fan in share.T if np.isfinite(fan).any()]
    for other, rad_s in RAD_S_PER_TABLE_UNIT.items():
        ratio = RAD_S_PER_TABLE_UNIT[unit] / rad_s
        if of_fans and ratio != 1.0 and all(abs(each / ratio - 1.0) < NEAR_UNIT for each in of_fans):
            raise FantwinError(
                f"{NAME} has speeds in {other}, not in {unit}: they are {ratio:.3g} times what the twin predicts; say "
                f'so: fantwin.Columns(speed="NAME:{other}")'
            )
