"""Which share of the samples of all fans was scored, and why the others were not."""

from __future__ import annotations

import numpy as np

from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Array
from fantwin.scoring.alarms.unscored_monitor import REASONS

SMALLEST_SHARE = 0.0005  # smaller ones are not named


class JudgedShare:
    """Counts the samples of one tray's fans since the start of a session."""

    def __init__(self) -> None:
        self._judged = 0
        self._not_judged = np.zeros(256, np.int64)
        """by reason"""

    def add(self, valid: Array, invalid_reason: Array) -> None:
        """Add the samples of a block. valid, invalid_reason: (n, fans)."""
        judged = int(np.count_nonzero(valid))
        self._judged += judged
        if judged < valid.size:
            self._not_judged += np.bincount(invalid_reason[~valid], minlength=256)

    @property
    def notes(self) -> list[str]:
        """One line; none before the first sample."""
        samples = self._judged + int(self._not_judged.sum())
        if not samples:
            return []
        reasons = [
            f"{100 * count / samples:.1f} % {REASONS.get(InvalidReason(reason), InvalidReason(reason).words)}"
            for reason, count in sorted(enumerate(self._not_judged.tolist()), key=lambda found: -found[1])
            if count >= SMALLEST_SHARE * samples
        ]
        because = f"; not judged: {', '.join(reasons)}" if reasons else ""
        return [f"{100 * self._judged / samples:.1f} % of the fans' samples judged{because}"]
