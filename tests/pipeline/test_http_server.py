"""The HTTP server in a thread, and where it listens."""

from __future__ import annotations

import http.client
import socket

import pytest
from starlette.applications import Starlette
from starlette.responses import JSONResponse
from starlette.routing import Route

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.http_server import HttpServer, listen
from tests.support.running_chain import eventually


async def _answer(_request: object) -> JSONResponse:
    return JSONResponse({})


def test_it_answers_without_delay_until_it_is_stopped_and_then_its_port_is_free() -> None:
    listening = listen("127.0.0.1", 0, "page")
    assert listening.proto == socket.IPPROTO_TCP, "asyncio would wait before it sends the end of an answer"
    port = listening.getsockname()[1]
    with pytest.raises(UserError, match=rf"^page.host = '127.0.0.1', page.port = {port}: cannot listen there \(Addr"):
        listen("127.0.0.1", port, "page")
    ended: list[bool] = []
    server = HttpServer(Starlette(routes=[Route("/", _answer)]), listening, None, 10, lambda: ended.append(True))
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", "/")
    assert (connection.getresponse().status, server.is_running) == (200, True)
    connection.close()
    server.stop()
    assert (ended, server.is_running) == ([True], False)
    listen("127.0.0.1", port, "page").close()


def test_with_too_many_connections_a_request_is_refused_until_there_is_room_again() -> None:
    listening = listen("127.0.0.1", 0, "page")
    address = listening.getsockname()
    server = HttpServer(Starlette(routes=[Route("/", _answer)]), listening, None, 3)

    def status() -> int:
        connection = http.client.HTTPConnection(*address, timeout=20)
        connection.request("GET", "/")
        answer = connection.getresponse()
        connection.close()
        return answer.status

    held = [socket.create_connection(address) for _ in range(3)]
    eventually(lambda: status() == 503, "it is refused")
    for each in held:
        each.close()
    eventually(lambda: status() == 200, "there is room again")
    server.stop()
