"""Errors of the bus."""

from __future__ import annotations

import zenoh

from pipeline.errors import UserError


class BusError(UserError):
    """The bus cannot be used: one line that says what, where and what to do."""


class NoAnswerError(BusError):
    """Who is on the bus is not known."""


def reason(error: zenoh.ZError) -> str:
    """Zenoh's message, without the place in its sources."""
    text = str(error)
    return (text.partition('msg: "')[2] or text).split(" at /")[0].strip()
