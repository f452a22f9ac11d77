"""Requests of operators that come by MQTT: checked, passed on, and answered on TOPIC/answer."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Annotated, Any

from pydantic import BaseModel, Field, ValidationError

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.mqtt.outbox import text_of
from fantwin.pipeline.outputs.mqtt.topics import ALL_FANS, ANSWER, REQUEST, Topics
from fantwin.pipeline.site.request_desk import ANSWERED_WITHIN_S, LONGEST_COMMENT, OneLine, RequestDesk, RequestForm
from fantwin.pipeline.site.site_json import answers_json
from fantwin.schemas.messages import Alarm, Request

OPERATOR_NAME = "mqtt"
"""who is recorded with each request: a broker does not say who sent a message"""
LARGEST_REQUEST_BYTES, LONGEST_ID = 4096, 64


class _Named(BaseModel):
    id: Annotated[str, Field(max_length=LONGEST_ID)] = ""


class MqttRequestForm(RequestForm):
    """A request as a message.

    Attributes:
        id: any word, repeated in the answer.
        name: who says that he asks; nothing proves it, and it goes into the comment.
    """

    id: Annotated[str, Field(max_length=LONGEST_ID)] = ""
    name: Annotated[OneLine, Field(max_length=64)] = ""

    def message(self, fan: int, operator_name: str) -> Request:
        """The request, with the name that the client gave in its comment."""
        says = f"sent as {self.name}" if self.name else ""
        comment = " ".join(filter(None, (self.comment, f"({says})" if self.comment and says else says)))
        return replace(super().message(fan, operator_name), comment=comment[:LONGEST_COMMENT])


@dataclass(frozen=True, eq=False)
class Waiting:
    """A request whose answers are to come. until_s: on the monotonic clock."""

    topic: str
    form: MqttRequestForm
    tray: str
    answers: Future[list[Alarm]]
    until_s: float


class Requests:
    """Takes messages, and gives answers: pairs of topic and text."""

    def __init__(self, topics: Topics, trays: Sequence[TrayConfig], accept: Sequence[str], desk: RequestDesk) -> None:
        self._topics = topics
        self._fans = {tray.name: tray.fans for tray in trays}
        self._accept = tuple(accept)
        self._desk = desk
        self._waiting: list[Waiting] = []
        self.counts: Counter[str] = Counter()

    def take(self, topic: str, payload: bytes, *, is_retained: bool) -> tuple[str, str] | None:
        """A message has come; returns its answer if it can be given at once."""
        parts = self._topics.parts(topic)
        if parts is None or parts[2] != REQUEST or not payload:  # an empty one deletes a retained one
            return None
        if is_retained:
            # the broker would send it again at each connection
            self.counts["retained_requests"] += 1
            return _answer(topic, "", {"error": "retained requests are ignored: send it without retain"})
        try:
            if len(payload) > LARGEST_REQUEST_BYTES:
                raise ValueError(f"at most {LARGEST_REQUEST_BYTES} bytes are accepted")
            form = MqttRequestForm.model_validate_json(payload)
        except ValueError as error:
            self.counts["malformed_requests"] += 1
            return _answer(topic, _id_of(payload), {"error": _why(error)})
        fans = self._fans_of(*parts[:2])
        error = ""
        if fans is None:
            error = f"no such fan: {parts[0]} has fans 0 to {self._fans.get(parts[0], 0) - 1}, and {ALL_FANS}"
        elif form.action not in self._accept:
            error = f"{form.action} is not accepted by MQTT here, only {', '.join(self._accept) or 'nothing'}"
        if error or fans is None:
            self.counts["refused_requests"] += 1
            return _answer(topic, form.id, {"error": error})
        asked = form.message(-1 if parts[1] == ALL_FANS else fans[0], OPERATOR_NAME)
        try:
            answers = self._desk.begin(parts[0], asked, fans)
        except TimeoutError as busy:
            self.counts["refused_requests"] += 1
            return _answer(topic, form.id, {"error": str(busy)})
        self.counts["accepted_requests"] += 1
        self._waiting.append(Waiting(topic, form, parts[0], answers, time.monotonic() + ANSWERED_WITHIN_S))
        return None

    def answers(self) -> list[tuple[str, str]]:
        """The answers that have come, and that none has."""
        now_s = time.monotonic()
        found: list[tuple[str, str]] = []
        for each in list(self._waiting):
            if each.answers.done():
                found.append(_answer(each.topic, each.form.id, answers_json(each.answers.result())))
            elif now_s > each.until_s:
                self.counts["unanswered_requests"] += 1
                found.append(_answer(each.topic, each.form.id, {"error": f"tray {each.tray}: no scorer has answered"}))
            else:
                continue
            self._waiting.remove(each)
        return found

    def _fans_of(self, tray: str, fan: str) -> Sequence[int] | None:
        fans = self._fans.get(tray, 0)
        if fans and fan == ALL_FANS:
            return range(fans)
        is_one = fan.isascii() and fan.isdigit() and len(fan) < 6 and int(fan) < fans
        return [int(fan)] if is_one else None


def _answer(topic: str, name: str, body: dict[str, Any]) -> tuple[str, str]:
    return f"{topic}/{ANSWER}", text_of(({"id": name} if name else {}) | {"ok": "error" not in body} | body)


def _id_of(payload: bytes) -> str:
    """Of a request that is none; empty if it has none that could be repeated."""
    try:
        return _Named.model_validate_json(payload[:LARGEST_REQUEST_BYTES]).id
    except ValueError:
        return ""


def _why(error: ValueError) -> str:
    if not isinstance(error, ValidationError):
        return str(error)
    found = error.errors(include_url=False, include_input=False, include_context=False)[0]
    where = ".".join(map(str, found["loc"]))
    return f"{where}: {found['msg']}" if where else found["msg"]
