"""Sweeps that operators ask of the learner of a tray, and what becomes of them; tells also which trays have no twin."""

from __future__ import annotations

import asyncio
import time

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.site.request_desk import ANSWERED_WITHIN_S, RequestDesk
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.enums import Action, InvalidReason
from fantwin.schemas.health import Sweep
from fantwin.schemas.messages import Request

_LOOK_S = 0.1


def why_not_judged(model: SiteModel, tray: str) -> str:
    """Why no scorer answers requests about the fans of a tray; empty: one may."""
    learning, config = model.learning().get(tray), model.tray(tray)
    without = (model.not_judged(tray) or {}).get(InvalidReason.NO_TWIN, ())
    if learning is None and (model.twin(tray) is not None or not config or len(without) < config.fans):
        return ""
    now = f" ({learning.what})" if learning else ""
    return (
        f"tray {tray} has no twin yet{now}: nothing judges its fans, and there is no alarm to act on; ask again when "
        "it has one, `fantwin status` says what that waits for"
    )


def sweep_of(model: SiteModel, tray: str) -> Sweep:
    """What operators may ask of the learner of a tray now.

    Raises:
        UserError: nothing; one line says why.
    """
    config, learning = model.tray(tray), model.learning().get(tray)
    if learning is not None and learning.sweep is not None:
        return learning.sweep
    if config and (reason := config.source.why_no_commands):
        raise UserError(f"tray {tray} takes no commands ({reason}): its own controller must move the fans")
    if learning is not None:
        raise UserError(
            f"no sweep of tray {tray} may be started from here: set `sweep_on_request = true` in [learner], or run "
            f"`fantwin command --tray {tray} --sweep`"
        )
    raise UserError(
        f"no learner waits for a first twin of tray {tray}: `fantwin command --tray {tray} --sweep` moves it"
    )


async def ask_for_sweep(model: SiteModel, desk: RequestDesk, tray: str, action: Action, operator_name: str) -> Sweep:
    """Begin or stop a sweep, and wait until the learner has taken the request.

    Raises:
        UserError: it may not be asked for, or was not begun.
        TimeoutError: the learner has not answered after ANSWERED_WITHIN_S.
    """
    sweep_of(model, tray)
    asked = Request(t_ns=time.time_ns(), action=action, operator_name=operator_name)
    under_way = desk.begin(tray, asked, ())
    try:
        async with asyncio.timeout(ANSWERED_WITHIN_S):
            while (now := sweep_of(model, tray)).asked_t_ns != asked.t_ns:
                await asyncio.sleep(_LOOK_S)
    except TimeoutError as error:
        raise TimeoutError(f"tray {tray}: no learner has answered") from error
    finally:
        under_way.cancel()
    if action == Action.SWEEP and not now.running:
        raise UserError(now.ended)
    return now
