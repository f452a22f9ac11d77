"""A stage is refused at its start where another process already has one of its trays."""

from __future__ import annotations

import threading
import time

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.runtime.sessions import Session, trays_in_words
from fantwin.pipeline.runtime.stage import StageError
from fantwin.pipeline.timebase.stage_clock import REPLAY
from fantwin.schemas.topics import ALL_TRAYS, alive_key, sessions_key

GOSSIP_S = 0.2
"""how long a starting stage waits for further processes after it has met the first: they took 6 ms"""
LEAVING_LIMIT_S = 2.0
"""how long it waits for a predecessor that is about to leave"""
_POLL_S = 0.02


def refuse_second(bus: Bus, site: str, session: Session, stop: threading.Event) -> None:
    """Return if no other process has a tray of this session in its stage, and no replay presents the site to a stage
    with a device; wait a moment for one that is about to leave.

    Raises:
        StageError: one does.
        BusError: a program that is not fantwin listens at the endpoint, or who is on the bus is not known.
    """
    replay = alive_key(site, REPLAY, ALL_TRAYS) if STAGES[session.stage].scope == "tray" else ""
    bus.wait_for_others(stop)
    met_s = time.monotonic()
    while True:
        others, is_replayed = _others(bus, site, session), bool(replay and bus.alive(replay))
        limit_s = LEAVING_LIMIT_S if others or is_replayed else GOSSIP_S
        if time.monotonic() - met_s >= limit_s or not bus.came_second or stop.wait(_POLL_S):
            break
    if is_replayed:
        raise StageError(
            f"a replay presents site {site!r}: stop it, or give {session.name} another site or bus.endpoint"
        )
    if others and others[0].instance == session.instance:
        raise StageError(
            f"{session.name} of site {site!r} already runs: {others[0].process}; stop that, or give this one another "
            "site, tray or bus.endpoint"
        )
    if others:
        shared = [tray for tray in session.trays or others[0].trays if others[0].has(tray)]
        raise StageError(
            f"{session.name} of site {site!r} cannot start: {others[0].name} already has {trays_in_words(shared)}: "
            f"{others[0].process}; stop that, or give this one other trays"
        )


def _others(bus: Bus, site: str, session: Session) -> list[Session]:
    found = filter(None, map(Session.of_key, bus.alive(sessions_key(site, session.stage))))
    others = (each for each in found if each != session and each.shares_a_tray_with(session))
    return [each for each in others if each.may_live(session.host)]
