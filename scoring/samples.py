"""A block of samples to be scored."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.enums import InvalidReason
from schemas.messages import Array, Prediction
from scoring.detectors.detector import Signal
from scoring.unseen_error import UnseenError

NO_SPEED = int(InvalidReason.NO_SPEED)
BALANCE_COUNTS = tuple(map(int, (InvalidReason.NONE, InvalidReason.WARMING_UP, InvalidReason.OUT_OF_RANGE)))
IDLE = tuple(map(int, (InvalidReason.STOPPED, InvalidReason.STARTING)))
NOT_ARRIVED = tuple(map(int, (InvalidReason.GAP, InvalidReason.STALE)))


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples:
    """Residuals in sigma of each fan. All (n, fans) but t_ns, (n,)."""

    t_ns: Array
    period_ns: int
    speed_rad_s: Array
    speed_residual: Array
    speed_valid: Array
    speed_sigma_rad_s: Array
    """the sigma of the speed residual"""
    speed_unseen: Array
    """standard deviation of the twin's own error where it was not trained, sigma; 0 where it was"""
    balance: Array
    balance_valid: Array
    balance_sigma: Array
    """that of the torque balance, in the unit of the command"""
    balance_unseen: Array
    """as speed_unseen"""
    command: Array
    predicted_rad_s: Array
    """what a healthy fan would read; NaN without a free run"""
    missing: Array
    """the tacho gave no reading, and its speed is not known from those around it"""
    reading_missing: Array
    """the newest raw sample has no reading; nowhere in recordings that do not tell"""
    idle: Array
    """the command stops the fan, or it has just started: nothing is compared with the twin"""
    alive: Array
    """samples arrived on the line"""

    def residual(self, source: Signal) -> tuple[Array, Array, Array, Array]:
        """One of the residuals, its sigma, where it is valid, and the twin's own error."""
        if source == "speed":
            return self.speed_residual, self.speed_sigma_rad_s, self.speed_valid, self.speed_unseen
        return self.balance, self.balance_sigma, self.balance_valid, self.balance_unseen

    def operating_speed_rad_s(self, *, is_predicted: bool) -> Array:
        """(n, fans) the speed that healthy residuals depend on: the reading, or what is predicted where it is known.

        Readings of a tacho that counts are steps. The mean residual of all samples with one reading says which speeds
        are rounded to it, and not how the fan differs from its twin.
        """
        if not is_predicted:
            return self.speed_rad_s
        return np.where(np.isfinite(self.predicted_rad_s), self.predicted_rad_s, self.speed_rad_s)

    def rows(self, rows: slice) -> Samples:
        """Some of the samples."""
        columns = {name: column[rows] for name, column in vars(self).items() if name != "period_ns"}
        return Samples(period_ns=self.period_ns, **columns)

    def fans(self, fans: slice) -> Samples:
        """Those of some fans."""
        columns = {name: column[:, fans] for name, column in vars(self).items() if name not in ("period_ns", "t_ns")}
        return Samples(period_ns=self.period_ns, t_ns=self.t_ns, **columns)


def samples_of(prediction: Prediction, unseen_error: UnseenError | None = None) -> Samples:
    """The samples of a block of predictions. unseen_error: of the twin; None: it does not say.

    The torque balance also counts while the free run warms up, and while the command is out of the twin's range, where
    a controller takes it when a fan fails.
    """
    invalid_reason, balance = prediction.invalid_reason, prediction.torque_balance_command
    residual = speed_residual_rad_s(prediction)
    with np.errstate(all="ignore"):
        speed_residual = residual / prediction.sigma_rad_s
        balance = balance / prediction.torque_balance_sigma_command
    speed_unseen = balance_unseen = np.zeros(residual.shape)
    if unseen_error:
        of_speed, of_balance = unseen_error.of(prediction)
        speed_unseen = of_speed / prediction.sigma_rad_s
        balance_unseen = of_balance / prediction.torque_balance_sigma_command
    balance_counts = among(invalid_reason, *BALANCE_COUNTS)
    return Samples(
        t_ns=prediction.t_ns,
        period_ns=prediction.period_ns,
        speed_rad_s=prediction.measured_speed_rad_s,
        speed_residual=speed_residual,
        speed_valid=prediction.valid & np.isfinite(speed_residual),
        speed_sigma_rad_s=np.broadcast_to(prediction.sigma_rad_s, residual.shape),
        speed_unseen=speed_unseen,
        balance=balance,
        balance_valid=balance_counts & np.isfinite(balance),
        balance_sigma=np.broadcast_to(prediction.torque_balance_sigma_command, residual.shape),
        balance_unseen=balance_unseen,
        command=prediction.command,
        predicted_rad_s=prediction.predicted_speed_rad_s,
        idle=among(invalid_reason, *IDLE),
        missing=invalid_reason == NO_SPEED,
        reading_missing=reading_missing_of(prediction),
        alive=arrived(invalid_reason),
    )


def arrived(invalid_reason: Array) -> Array:
    """Where samples arrived on the line."""
    return ~among(invalid_reason, *NOT_ARRIVED)


def among(values: Array, first: int, *others: int) -> Array:
    """Where values are one of these; of small blocks faster than np.isin by several times."""
    found: Array = values == first
    for other in others:
        found |= values == other
    return found


def reading_missing_of(prediction: Prediction) -> Array:
    """(n, fans) of bool: where the newest raw sample has no reading; nowhere if the message does not tell."""
    given = prediction.reading_missing
    return given if len(given) else np.zeros(prediction.valid.shape, np.bool_)


def speed_residual_rad_s(prediction: Prediction) -> Array:
    """(n, fans) how far each reading is from the nearest one that the tacho may show of a healthy fan, rad/s."""
    residual = prediction.measured_speed_rad_s - prediction.predicted_speed_rad_s
    half_range = prediction.reading_range_rad_s
    return residual - residual.clip(-half_range, half_range) if len(half_range) else residual
