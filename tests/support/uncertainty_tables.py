"""Tables of a twin's own error by absolute speeds, for tests."""

from __future__ import annotations

from collections.abc import Sequence

from fantwin.schemas.model_uncertainty import ModelUncertainty


def by_speed(
    speeds_rad_s: Sequence[float],
    commands: Sequence[float],
    std_rad_s: Sequence[Sequence[float]],
    seen_std_rad_s: float,
) -> ModelUncertainty:
    """The table of one fan that settles at 0 rad/s at every command. std_rad_s: (speeds, commands)."""
    by_command = tuple(zip(*std_rad_s, strict=True))
    settled = (0.0,) * len(commands)
    return ModelUncertainty(tuple(speeds_rad_s), tuple(commands), (by_command,), (seen_std_rad_s,), (settled,))
