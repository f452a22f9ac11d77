"""The API, version 1: everything that the page shows and does, as JSON. `openapi.json` describes it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, JSONResponse
from fastapi.security import APIKeyCookie, HTTPBearer

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.web import answers as typed
from fantwin.pipeline.outputs.web.access import Access, address_of, require_own_page, require_token
from fantwin.pipeline.outputs.web.answers import JSON, LoginForm
from fantwin.pipeline.outputs.web.live_feed import EventStream, LiveFeed, SharedAnswer, encoded
from fantwin.pipeline.outputs.web.metrics import metrics_text
from fantwin.pipeline.recordings.clips.clip import Clip, kept_clips
from fantwin.pipeline.site.fan_history import HISTORY_S
from fantwin.pipeline.site.fan_series import FanSeries
from fantwin.pipeline.site.fans_json import fans_json, sweep_json
from fantwin.pipeline.site.fleet import Fan, FanGroup
from fantwin.pipeline.site.request_desk import RequestDesk, RequestForm
from fantwin.pipeline.site.site_json import (
    alarms_json,
    answers_json,
    clip_json,
    fan_in_full,
    fleet_json,
    rates_json,
    site_json,
    sparks_json,
    stages_json,
    transition_json,
)
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.pipeline.site.sweep_requests import ask_for_sweep, sweep_of, why_not_judged
from fantwin.schemas.enums import Action
from fantwin.schemas.units import NS_PER_S

MOST_LISTED = 500
MOST_POINTS = 4000
MOST_SERIES, MOST_SERIES_WAITING = 2, 64
"""series that are read at once, and that wait for it"""
CLIP_TYPE = "application/octet-stream"
CSV_TYPE = "text/csv"
METRICS_TYPE = "text/plain; version=0.0.4; charset=utf-8"
ALL_FANS = "all"

Whole = Annotated[int, Query(ge=0, lt=10**15)]
Of = Annotated[str, Query(description="name of a tray; empty: all")]
_PROBLEMS = {
    401: "nobody is logged in",
    403: "the user may not do this",
    404: "no such tray, fan or clip",
    422: "a parameter or a field is wrong",
    503: "a file cannot be read",
    504: "no scorer has answered",
}
_RESPONSES: dict[int | str, dict[str, Any]] = {
    code: {"model": typed.Problem, "description": why} for code, why in _PROBLEMS.items()
}
_EVENTS: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/event-stream": {"schema": {"type": "string"}}}, "description": "live events"}
}
_FILE: dict[int | str, dict[str, Any]] = {
    200: {"content": {CLIP_TYPE: {"schema": {"type": "string", "format": "binary"}}}, "description": "an MCAP file"}
}
_TABLE: dict[int | str, dict[str, Any]] = {
    200: {"content": {CSV_TYPE: {"schema": {"type": "string"}}}, "description": "JSON, or a table"}
}
_REFUSED: dict[int | str, dict[str, Any]] = {
    409: {"model": typed.Refused, "description": "the scorer has refused it, or the tray has no twin yet"}
}
_NOT_SWEPT: dict[int | str, dict[str, Any]] = {409: {"model": typed.Problem, "description": "nobody may, or not now"}}


@dataclass(frozen=True, eq=False)
class Api:
    """The handlers. Those that are no coroutines run in threads: live events go on meanwhile."""

    model: SiteModel
    access: Access
    feed: LiveFeed
    desk: RequestDesk
    viewer_urls: Mapping[str, str]
    """by tray, of Rerun's viewer for browsers; none where it is not served"""
    series: FanSeries
    """reads recordings"""
    clip_folders: Sequence[Path] = ()
    """of the alarm clips of recorders on this host"""
    _shared: dict[str, SharedAnswer] = field(default_factory=dict[str, SharedAnswer], init=False)
    _reads: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(MOST_SERIES), init=False)
    _waiting: set[object] = field(default_factory=set[object], init=False)

    def routes(self) -> APIRouter:
        """Which path answers what, as which type, and to whom."""
        router = APIRouter(responses=_RESPONSES)
        token = Depends(HTTPBearer(auto_error=False, description="of `fantwin users add-token`"))
        session = Depends(APIKeyCookie(name=self.access.cookie_name, auto_error=False, description="of `/login`"))
        shown = [token, session]  # for openapi.json; `Access` decides
        get = partial(router.add_api_route, methods=["GET"], dependencies=[Depends(self.access.reader), *shown])
        get("/site", self.site, response_model=typed.Site)
        get("/fans", self.fans, response_model=typed.Fans)
        get("/fans/{tray}/{fan}", self.fan, response_model=typed.FanInFull)
        get("/fans/{tray}/{fan}/series", self.series_of, response_model=typed.Series, responses=_TABLE)
        get("/sparks", self.sparks, response_model=typed.Sparks)
        get("/alarms", self.alarms, response_model=typed.Alarms)
        get("/alarms/history", self.alarm_history, response_model=typed.History)
        get("/alarm-rate", self.alarm_rate, response_model=typed.Rates)
        get("/clips", self.clips, response_model=typed.Clips)
        get("/clips/{name}", self.clip, response_class=FileResponse, responses=_FILE)
        get("/stages", self.stages, response_model=typed.Stages)
        get("/events", self.events, response_class=EventStream, responses=_EVENTS)
        router.add_api_route("/me", self.me, response_model=typed.Me, dependencies=shown)
        post = partial(router.add_api_route, methods=["POST"])
        own = [Depends(require_own_page)]
        post("/login", self.log_in, response_model=typed.Session, dependencies=own)
        post("/logout", self.log_out, dependencies=own)
        act = {"response_model": typed.ScorerAnswers, "responses": _REFUSED}
        acts = [Depends(self.access.operator), *shown]
        post("/fans/{tray}/{fan}/requests", self.act, dependencies=acts, **act)
        swept = {"response_model": typed.Sweep, "responses": _NOT_SWEPT}
        get("/trays/{tray}/sweep", self.sweep, **swept)
        post("/trays/{tray}/sweep", self.start_sweep, dependencies=acts, **swept)
        router.add_api_route("/trays/{tray}/sweep", self.stop_sweep, methods=["DELETE"], dependencies=acts, **swept)
        return router

    async def site(self) -> JSON:
        """Trays, fans, and what the classes of cells mean."""
        return site_json(self.model, self.viewer_urls)

    def fans(self, tray: Of = "", state: FanGroup | None = None, limit: Whole = 10_000_000) -> Response:
        """All fans, the worst first."""
        if tray:
            self._tray(tray)
        found = [each for each in self.model.every_fan() if tray in ("", each.fan.tray) and state in (None, each.group)]
        return JSONResponse({"fans": fans_json(self.model, found[:limit])})  # to check 5,000 of them takes long

    async def fan(self, tray: str, fan: str) -> JSON:
        """One fan with its alarm, its twin and its wear."""
        return fan_in_full(self.model, self._fan(tray, fan))

    async def series_of(
        self,
        request: Request,
        tray: str,
        fan: str,
        begin_s: Annotated[
            float | None, Query(ge=0, le=4e9, alias="from", description="seconds since 1970; default: an hour")
        ] = None,
        end_s: Annotated[
            float | None, Query(ge=0, le=4e9, alias="to", description="seconds since 1970; default: now")
        ] = None,
        points: Annotated[int, Query(ge=1, le=MOST_POINTS)] = 1000,
        format: Literal["json", "csv"] = "json",
    ) -> Response:
        """A fan over any range of time, in at most `points` points, each with its least, mean and largest value."""
        found = self._fan(tray, fan)
        end_ns = (self.model.newest_t_ns(tray) or time.time_ns()) + 1 if end_s is None else round(end_s * NS_PER_S)
        begin_ns = end_ns - HISTORY_S * NS_PER_S if begin_s is None else round(begin_s * NS_PER_S)
        if begin_ns >= end_ns:
            raise HTTPException(422, "from: is not before to")
        if len(self._waiting) >= MOST_SERIES_WAITING:
            raise HTTPException(503, "too many ask for series: try again")
        self._waiting.add(request)
        try:
            async with self._reads:
                if await request.is_disconnected():
                    return Response()
                make = self.series.as_csv if format == "csv" else self.series.as_json
                made = await asyncio.to_thread(make, found, max(begin_ns, 0), end_ns, points)
        except UserError as error:
            raise HTTPException(503, "the history cannot be read: see the problem of the gateway") from error
        finally:
            self._waiting.discard(request)
        if isinstance(made, str):
            headers = {"Content-Disposition": f'attachment; filename="{tray}-fan{found.number}.csv"'}
            return Response(made, media_type=CSV_TYPE, headers=headers)
        return JSONResponse(made)

    async def sparks(self, request: Request) -> Response:
        """The last minute of all fans; of a large site, of those in alarm."""
        return await self._answer("sparks", partial(sparks_json, self.model)).to(request)

    async def alarms(self, request: Request, all: bool = False) -> Response:
        """The current alarms, or also those that are over."""
        name = "all alarms" if all else "alarms"
        return await self._answer(name, partial(alarms_json, self.model, everything=all)).to(request)

    def alarm_history(self, tray: Of = "", fan: int = -1, limit: Whole = 100, before: Whole | None = None) -> JSON:
        """The last transitions, the newest first; `before`: the number of the last one, for the next page."""
        try:
            found = self.model.past.newest(min(MOST_LISTED, limit), tray=tray, fan=fan, before=before)
            begins_t_ns = self.model.past.begins_t_ns()
            feedback = self.model.feedback_on([alarm for _, alarm in found])
        except UserError as error:
            raise HTTPException(503, "the history cannot be read: see the problem of the gateway") from error
        rows = [transition_json(number, alarm, said) for (number, alarm), said in zip(found, feedback, strict=True)]
        return {"transitions": rows, "begins_t_ns": begins_t_ns}

    async def alarm_rate(self, request: Request) -> Response:
        """The observed rate of false alarms beside the declared one, of each tray and of the site."""
        try:
            return await self._answer("rate", partial(rates_json, self.model)).to(request)
        except UserError as error:
            raise HTTPException(503, "the rate cannot be read: see the problem of the gateway") from error

    def clips(self, tray: Of = "") -> JSON:
        """The recordings around alarms that can be downloaded, the newest first."""
        return {"clips": [clip_json(clip) for _, clip in self._kept_clips() if tray in ("", clip.tray)]}

    def clip(self, name: str) -> FileResponse:
        """Download an alarm clip, an MCAP file."""
        for folder, clip in self._kept_clips():
            if clip.name == name:
                headers = {"Content-Encoding": "identity"}  # it is compressed already
                return FileResponse(folder / clip.name, 200, headers, CLIP_TYPE, filename=clip.name)
        raise HTTPException(404, "no such clip")

    async def stages(self) -> JSON:
        """The stages: state, rates, losses, latency."""
        return {"stages": stages_json(self.model.stages())}

    async def events(
        self, request: Request, fan: Annotated[str, Query(description="TRAY/NUMBER or TRAY/NAME")] = ""
    ) -> Response:
        """Live events, with the samples of a fan if it is named."""
        looked_at = None
        if fan:
            tray, _, number = fan.rpartition("/")
            looked_at = self._fan(tray, number)
        first = encoded("fleet", fleet_json(self.model))
        return EventStream(
            self.feed.events(first, looked_at, partial(self.access.may_still_read, request)),
            headers={"X-Accel-Buffering": "no"},  # of a proxy
        )

    async def metrics(self, request: Request) -> Response:
        """Metrics in the text format of Prometheus."""
        await self.access.reader(request)
        return Response(await run_in_threadpool(metrics_text, self.model, self.feed.readers), media_type=METRICS_TYPE)

    async def me(self, request: Request) -> typed.Me:
        """Who asks, and what it may do; the token that a page sends with what it changes."""
        visitor = self.access.visitor(request)
        return typed.Me(
            name=visitor.name,
            may_read=visitor.may_read,
            may_act=visitor.may_act,
            has_login=self.access.has_login,
            csrf_token=visitor.session.csrf_token if visitor.session else "",
        )

    async def log_in(self, form: LoginForm, request: Request, response: Response) -> typed.Session:
        """Begin a session."""
        cookie, session = await self.access.log_in(form.name, form.password, request)
        response.set_cookie(value=cookie, **self.access.cookie)
        return typed.Session(name=session.user, csrf_token=session.csrf_token)

    async def log_out(self, request: Request, response: Response) -> dict[str, str]:
        """End the session."""
        visitor = self.access.visitor(request)
        if visitor.session is not None:
            require_token(request, visitor.session)
            self.access.sessions.end(request.cookies[self.access.cookie_name])
            self.access.log.add("logout", user=visitor.name, **address_of(request))
        response.delete_cookie(**self.access.cookie)
        return {}

    async def act(self, tray: str, fan: str, form: RequestForm, request: Request) -> Any:
        """Send an operator's request about a fan, or all fans of a tray, and answer what the scorer says."""
        name = self.access.visitor(request).name
        one = None if fan == ALL_FANS else self._fan(tray, fan).number
        fans = range(self._tray(tray).fans) if one is None else [one]
        asked = form.message(-1 if one is None else one, name)
        if why := why_not_judged(self.model, tray):
            return JSONResponse({"error": why, "answers": []}, 409)
        about = f"{tray} {ALL_FANS if one is None else one}"
        self.access.log.add("request", user=name, action=form.action, fan=about, **address_of(request))
        try:
            said = await self.desk.ask(tray, asked, fans)
        except TimeoutError as error:
            raise HTTPException(504, str(error) or f"tray {tray}: no scorer has answered") from error
        body = answers_json(said)
        return JSONResponse(body, 409) if "error" in body else body

    async def sweep(self, tray: str) -> JSON:
        """The sweep of a tray without a twin: what it would do, what it does, how the last one ended."""
        self._tray(tray)
        try:
            return sweep_json(sweep_of(self.model, tray))
        except UserError as error:
            raise HTTPException(409, str(error)) from error

    async def start_sweep(self, tray: str, request: Request) -> JSON:
        """Move the fans of a tray without a twin over their range, so that it can be learned."""
        return await self._ask_for_sweep(tray, Action.SWEEP, request)

    async def stop_sweep(self, tray: str, request: Request) -> JSON:
        """Stop that: the fans get the commands that they had before."""
        return await self._ask_for_sweep(tray, Action.STOP_SWEEP, request)

    async def _ask_for_sweep(self, tray: str, action: Action, request: Request) -> JSON:
        self._tray(tray)
        name = self.access.visitor(request).name
        self.access.log.add("request", user=name, action=action.name.lower(), fan=f"{tray} all", **address_of(request))
        try:
            return sweep_json(await ask_for_sweep(self.model, self.desk, tray, action, name))
        except UserError as error:
            raise HTTPException(409, str(error)) from error
        except TimeoutError as error:
            raise HTTPException(504, str(error)) from error

    def _answer(self, name: str, make: Callable[[], Any]) -> SharedAnswer:
        """The one for all who ask for this."""
        if name not in self._shared:
            self._shared[name] = SharedAnswer(make)
        return self._shared[name]

    def _kept_clips(self) -> list[tuple[Path, Clip]]:
        listed = [(folder, clip) for folder in self.clip_folders for clip in kept_clips(folder)]
        return [(folder, clip) for folder, clip in listed if self.model.tray(clip.tray)]

    def _fan(self, tray: str, fan: str) -> Fan:
        """Find a fan by its number or its name."""
        try:
            return Fan(tray, self._tray(tray).fan_called(fan))
        except UserError as error:
            raise HTTPException(404, f"no such fan: {error}") from error

    def _tray(self, name: str) -> TrayConfig:
        found = self.model.tray(name)
        if found is None:
            raise HTTPException(404, "no such tray")
        return found
