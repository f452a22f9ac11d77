"""Errors of the bus."""

from __future__ import annotations

import zenoh

from fantwin.pipeline.errors import UserError


class BusError(UserError):
    """The bus cannot be used: one line that says what, where and what to do."""


class NoAnswerError(BusError):
    """No complete answer came to the question who is on the bus."""


def reason(error: zenoh.ZError) -> str:
    """Zenoh's message, without the place in its sources."""
    text = str(error)
    return (text.partition('msg: "')[2] or text).split(" at /")[0].strip()
