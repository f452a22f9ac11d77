"""The API, version 1: everything that the page shows and does, as JSON. `openapi.json` describes it."""

from __future__ import annotations

import asyncio
import json
import re
import time
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import aclosing
from dataclasses import dataclass, field
from functools import partial, wraps
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.web.access import Access, Visitor, address_of, require_own_page, require_token
from fantwin.pipeline.outputs.web.forms import LoginForm
from fantwin.pipeline.outputs.web.live_feed import LiveFeed, encoded
from fantwin.pipeline.outputs.web.metrics import metrics_text
from fantwin.pipeline.outputs.web.shared_answer import SharedAnswer
from fantwin.pipeline.recordings.clips.clip import Clip, kept_clips
from fantwin.pipeline.site.fan_groups import FanGroup
from fantwin.pipeline.site.fan_history import HISTORY_S
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.request_desk import RequestDesk
from fantwin.pipeline.site.request_form import RequestForm
from fantwin.pipeline.site.shown import (
    alarms_json,
    clip_json,
    curves_json,
    fan_in_full,
    fan_json,
    fleet_json,
    rates_json,
    site_json,
    stages_json,
    transition_json,
)
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Request as OperatorRequest
from fantwin.schemas.units import NS_PER_S

MOST_LISTED = 500
LARGEST_BODY_BYTES, BODY_WITHIN_S = 16_384, 10.0
CHECKED_EVERY_S = 5.0
"""so often it is looked whether a reader of live events may still read"""
CLIP_TYPE = "application/octet-stream"
METRICS_TYPE = "text/plain; version=0.0.4; charset=utf-8"
ALL_FANS = "all"

Form = TypeVar("Form", bound=BaseModel)
Handler = Callable[[Any, Request], Awaitable[Response]]


def reads(handler: Handler) -> Handler:
    """A handler of whoever may read."""

    @wraps(handler)
    async def checked(api: Api, request: Request) -> Response:
        api.access.reader(request)
        return await handler(api, request)

    return checked


@dataclass(frozen=True, eq=False)
class Api:
    """The handlers."""

    model: SiteModel
    access: Access
    feed: LiveFeed
    desk: RequestDesk
    viewer_urls: Mapping[str, str]
    """by tray, of Rerun's viewer for browsers; none where it is not served"""
    clip_folders: Sequence[Path] = ()
    """of the alarm clips of recorders on this host"""
    _shared: dict[str, SharedAnswer] = field(default_factory=dict[str, SharedAnswer], init=False)

    @reads
    async def site(self, request: Request) -> Response:
        """Trays, fans and what the classes of cells mean."""
        return JSONResponse(site_json(self.model, self.viewer_urls))

    @reads
    async def fans(self, request: Request) -> Response:
        """All fans, the worst first; ?tray=NAME, ?state=GROUP and ?limit=N choose."""
        tray, group = request.query_params.get("tray", ""), _group(request)
        if tray:
            self._tray(tray)
        most = _number(request, "limit", 10_000_000)
        groups = self.model.groups()
        found = [
            (each, groups[each.fan])
            for each in self.model.every_fan()
            if tray in ("", each.fan.tray) and group in (None, groups[each.fan])
        ]
        return JSONResponse({"fans": [fan_json(each, of) for each, of in found[:most]]})

    @reads
    async def fan(self, request: Request) -> Response:
        """One fan with its alarm and its twin."""
        return JSONResponse(fan_in_full(self.model, self._fan(request)))

    @reads
    async def curves(self, request: Request) -> Response:
        """The last hour of a fan, or its last ?seconds=N."""
        fan = self._fan(request)
        since_t_ns = self.model.newest_t_ns(fan.tray) - round(_number(request, "seconds", HISTORY_S) * NS_PER_S)
        tray = self._tray(fan.tray)
        return JSONResponse(curves_json(self.model.history(fan, since_t_ns), tray))

    @reads
    async def alarms(self, request: Request) -> Response:
        """The current alarms; ?all=1 also those that are over."""
        everything = request.query_params.get("all", "") == "1"
        name = "all alarms" if everything else "alarms"
        return await self._answer(name, partial(alarms_json, self.model, everything=everything)).to(request)

    @reads
    async def alarm_history(self, request: Request) -> Response:
        """The last transitions, newest first; ?tray=, ?fan=, ?limit=, and ?before=NUMBER for the next page. With them,
        how far back the history reaches, and whether earlier alarms are still being read from recordings."""
        try:
            found = self.model.past_alarms(
                min(MOST_LISTED, _number(request, "limit", 100)),
                tray=request.query_params.get("tray", ""),
                fan=_number(request, "fan", -1),
                before=_whole(request, "before"),
            )
            begins_t_ns = self.model.history_begins_t_ns()
            feedback = self.model.feedback_on([alarm for _, alarm in found])
        except UserError as error:
            raise HTTPException(503, "the history cannot be read: see the problem of the gateway") from error
        return JSONResponse(
            {
                "transitions": [
                    transition_json(number, alarm, said) for (number, alarm), said in zip(found, feedback, strict=True)
                ],
                "begins_t_ns": begins_t_ns,
            }
        )

    @reads
    async def alarm_rate(self, request: Request) -> Response:
        """The rate of false alarms that really was beside the declared one, of each tray and of the site."""
        try:
            return await self._answer("rate", partial(rates_json, self.model)).to(request)
        except UserError as error:
            raise HTTPException(503, "the rate cannot be read: see the problem of the gateway") from error

    @reads
    async def clips(self, request: Request) -> Response:
        """The recordings around alarms that can be downloaded, the newest first; ?tray=NAME chooses."""
        tray = request.query_params.get("tray", "")
        found = await run_in_threadpool(self._kept_clips)
        return JSONResponse({"clips": [clip_json(clip) for _, clip in found if tray in ("", clip.tray)]})

    @reads
    async def clip(self, request: Request) -> Response:
        """Download an alarm clip, an MCAP file."""
        found = await run_in_threadpool(self._kept_clips)
        for folder, clip in found:
            if clip.name == request.path_params["name"]:
                headers = {"Content-Encoding": "identity"}  # it is compressed already
                return FileResponse(folder / clip.name, 200, headers, CLIP_TYPE, filename=clip.name)
        raise HTTPException(404, "no such clip")

    @reads
    async def stages(self, request: Request) -> Response:
        """The stages: state, rates, losses, latency."""
        return JSONResponse({"stages": stages_json(self.model.stages())})

    @reads
    async def events(self, request: Request) -> Response:
        """Live events (text/event-stream); ?fan=TRAY/NUMBER adds the samples of a fan."""
        fan = None
        if name := request.query_params.get("fan", ""):
            fan = self._named(*name.rpartition("/")[::2])
        first = encoded("fleet", fleet_json(self.model))
        events = self._while_allowed(request, self.feed.events(first, fan))
        return StreamingResponse(events, media_type="text/event-stream", headers={"X-Accel-Buffering": "no"})

    async def metrics(self, request: Request) -> Response:
        """For Prometheus. Meanwhile live events go on."""
        await self.access.require_scraper(request)
        text = await run_in_threadpool(metrics_text, self.model, self.feed.readers)
        return Response(text, media_type=METRICS_TYPE)

    async def me(self, request: Request) -> Response:
        """Who asks, and what he may do; the token that a page sends with what it changes."""
        return JSONResponse(self._me(self.access.visitor(request)))

    async def log_in(self, request: Request) -> Response:
        """Begin a session."""
        require_own_page(request)
        form = await _form(request, LoginForm)
        cookie, session = await self.access.log_in(form.name, form.password, request)
        answer = JSONResponse({"name": session.user, "csrf_token": session.csrf_token})
        answer.set_cookie(
            self.access.cookie_name, cookie, httponly=True, samesite="strict", secure=self.access.is_cookie_secure
        )
        return answer

    async def log_out(self, request: Request) -> Response:
        """End the session."""
        require_own_page(request)
        visitor = self.access.visitor(request)
        if visitor.session is not None:
            require_token(request, visitor.session)
            self.access.sessions.end(request.cookies[self.access.cookie_name])
            self.access.log.add("logout", user=visitor.name, **address_of(request))
        answer = JSONResponse({})
        answer.delete_cookie(
            self.access.cookie_name, httponly=True, samesite="strict", secure=self.access.is_cookie_secure
        )
        return answer

    async def act(self, request: Request) -> Response:
        """Send an operator's request about a fan, or all fans of a tray, and answer what the scorer says."""
        visitor = self.access.operator(request)
        form = await _form(request, RequestForm)
        name = request.path_params["tray"]
        tray = self._tray(name)
        is_all = request.path_params["fan"] == ALL_FANS
        fan = -1 if is_all else self._fan(request).number
        asked = OperatorRequest(
            t_ns=time.time_ns(),
            action=form.message_action,
            fan=fan,
            duration_s=form.duration_s,
            operator_name=visitor.name,
            comment=form.comment,
            onset_t_ns=form.onset_t_ns,
        )
        where = f"{name} {'all' if is_all else fan}"
        self.access.log.add("request", user=visitor.name, action=form.action, fan=where, **address_of(request))
        try:
            answers = await self.desk.ask(name, asked, range(tray.fans) if is_all else [fan])
        except TimeoutError as error:
            raise HTTPException(504, str(error) or f"tray {name}: no scorer has answered") from error
        refused = [each for each in answers if each.transition == Transition.REFUSED]
        body = {
            "answers": [
                {"fan": each.fan, "transition": each.transition.name.lower(), "message": each.message}
                for each in answers
            ]
        }
        if len(refused) == len(answers):
            return JSONResponse({"error": refused[0].message, **body}, 409)
        return JSONResponse(body)

    async def _while_allowed(self, request: Request, events: AsyncIterator[bytes]) -> AsyncGenerator[bytes]:
        """The events, until the reader may not read any more. A page that is open keeps its session from being idle."""
        checked_s = time.monotonic()
        async with aclosing(events):  # type: ignore[type-var]  it is a generator
            async for event in events:
                if time.monotonic() - checked_s >= CHECKED_EVERY_S:
                    checked_s = time.monotonic()
                    if not self.access.visitor(request).may_read:
                        return
                yield event

    def _me(self, visitor: Visitor) -> dict[str, Any]:
        return {
            "name": visitor.name,
            "may_read": visitor.may_read,
            "may_act": visitor.may_act,
            "has_login": self.access.has_login,
            "csrf_token": visitor.session.csrf_token if visitor.session else "",
        }

    def _answer(self, name: str, make: Callable[[], Any]) -> SharedAnswer:
        """The one for all who ask for this."""
        if name not in self._shared:
            self._shared[name] = SharedAnswer(make)
        return self._shared[name]

    def _kept_clips(self) -> list[tuple[Path, Clip]]:
        listed = [(folder, clip) for folder in self.clip_folders for clip in kept_clips(folder)]
        return [(folder, clip) for folder, clip in listed if self.model.tray(clip.tray)]

    def _fan(self, request: Request) -> Fan:
        return Fan(*self._named(request.path_params["tray"], request.path_params["fan"]))

    def _named(self, tray: str, fan: str) -> tuple[str, int]:
        found = self._tray(tray)
        if not (fan.isascii() and fan.isdigit() and len(fan) < 6 and int(fan) < found.fans):
            raise HTTPException(404, f"no such fan: {tray} has fans 0 to {found.fans - 1}")
        return tray, int(fan)

    def _tray(self, name: str) -> TrayConfig:
        found = self.model.tray(name)
        if found is None:
            raise HTTPException(404, "no such tray")
        return found


async def broken(api: Api, request: Request, error: Exception) -> Response:
    """The answer to a request at which the gateway itself has failed; why, only the log says."""
    why = f"{type(error).__name__}: {error}"
    api.access.log.add("gateway failed", path=request.url.path, why=why, **address_of(request))
    return JSONResponse({"error": "the gateway has failed; its log says why"}, 500)


async def failed(_request: Request, error: Exception) -> Response:
    """The answer to what cannot be done: {"error": why}."""
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": error.detail}, error.status_code, error.headers)


async def _form(request: Request, kind: type[Form]) -> Form:
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise HTTPException(415, "send application/json")
    body = bytearray()
    try:
        async with asyncio.timeout(BODY_WITHIN_S):
            async for piece in request.stream():
                body += piece
                if len(body) > LARGEST_BODY_BYTES:
                    raise HTTPException(413, f"at most {LARGEST_BODY_BYTES} bytes are accepted")
    except TimeoutError as error:
        raise HTTPException(408, "the request took too long") from error
    try:
        return kind.model_validate_json(bytes(body))
    except ValidationError as error:
        found = json.loads(error.json(include_url=False, include_input=False))[0]
        where = ".".join(map(str, found["loc"]))
        raise HTTPException(422, f"{where}: {found['msg']}" if where else found["msg"]) from error


def _group(request: Request) -> FanGroup | None:
    """The group that is asked for; None: all."""
    name = request.query_params.get("state", "")
    if name and name not in list(FanGroup):
        raise HTTPException(422, f"state must be one of {', '.join(FanGroup)}")
    return FanGroup(name) if name else None


def _number(request: Request, name: str, default: int) -> int:
    number = _whole(request, name)
    if number is None:
        return default
    if number < 0:
        raise HTTPException(422, f"{name} must not be below 0")
    return number


def _whole(request: Request, name: str) -> int | None:
    text = request.query_params.get(name, "")
    if not text:
        return None
    if not re.fullmatch("-?[0-9]{1,15}", text):
        raise HTTPException(422, f"{name} must be a whole number")
    return int(text)
