"""Words for what a fan with an alarm does now: the alarm may go on although its newest samples have no deviation."""

from __future__ import annotations

from fantwin.schemas.enums import FanState, InvalidReason

RETURNING = "like a healthy fan again (the alarm clears after ten seconds of it)"
STOPPED, STARTING = "stopped by its command", "starting"


def words_now(state: int, invalid_reason: int = InvalidReason.NONE) -> str:
    """Words after "now": that the fan is stopped, starting or like a healthy fan again; empty: none of these.

    state and invalid_reason: `FanState` and `InvalidReason` of the newest sample.
    """
    if state == FanState.STOPPED or invalid_reason == InvalidReason.STOPPED:
        return STOPPED
    if state == FanState.STARTING or invalid_reason == InvalidReason.STARTING:
        return STARTING
    return RETURNING if state == FanState.RETURNING else ""
