"""A Prometheus, or an exporter, on loopback: an HTTP server with the answers that a test gives it."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs

Values = list[tuple[float, str]]


class Metrics:
    """What the server answers, which a test changes while it is asked."""

    def __init__(self) -> None:
        self.status = 200
        self.text = ""
        """body of an exporter's page, and of an answer that is none of Prometheus"""
        self.series: list[tuple[dict[str, str], Values]] = []
        """labels and samples that a query finds"""
        self.header = ""
        """the `Authorization` that is let in; empty: any"""
        self.queries: list[str] = []

    def answer(self, path: str, body: str, authorization: str) -> tuple[int, str]:
        """Status and body."""
        if self.header and authorization != self.header:
            return 401, ""
        if path != "/api/v1/query" or self.text:
            return self.status, self.text
        self.queries += parse_qs(body)["query"]
        if self.status != 200:
            return self.status, json.dumps({"status": "error", "errorType": "bad_data", "error": "a parse error"})
        result: list[dict[str, Any]] = [{"metric": labels, "values": values} for labels, values in self.series]
        return 200, json.dumps({"status": "success", "data": {"resultType": "matrix", "result": result}})


@contextmanager
def metrics_server(metrics: Metrics) -> Iterator[str]:
    """Serve it; gives its URL."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self._answer("")

        def do_POST(self) -> None:
            self._answer(self.rfile.read(int(self.headers["Content-Length"])).decode())

        def _answer(self, body: str) -> None:
            status, text = metrics.answer(self.path, body, self.headers.get("Authorization", ""))
            self.send_response(status)
            self.send_header("Location", "http://127.0.0.1:9/")
            self.end_headers()
            self.wfile.write(text.encode())

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join(5.0)
        server.server_close()
