"""One Prometheus, or one exporter: what it is asked, once for all trays of this process that it has the fans of."""

from __future__ import annotations

import base64
import http.client
import json
import math
import re
import ssl
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias
from weakref import WeakValueDictionary

from prometheus_client.parser import text_string_to_metric_families

from fantwin.pipeline.certificates import client_context, tls_refusal
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.host_address import is_of_this_host_only
from fantwin.pipeline.sources.polling import MOST_FAILURES, DeviceError
from fantwin.pipeline.sources.prometheus.config import NAME, Labels, PrometheusConfig
from fantwin.pipeline.sources.secret_file import read_secret
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.schemas.units import NS_PER_S

TIMEOUT_S = 5.0
LARGEST_ANSWER = 64 << 20
"""bytes"""
LONGEST_BACK_S = 3600.0
"""time before now of which samples are asked for, after Prometheus was away"""

Samples: TypeAlias = Sequence[tuple[int, float]]
"""times, ns since 1970, and values, by rising time"""
Series: TypeAlias = tuple[tuple[str, str], ...]
"""labels that a series has to have, in their order"""
Answer: TypeAlias = Mapping[Series, Sequence[Samples]]
"""what was found for each: none, one, or several where the labels do not tell them apart"""


def period_number(period_s: float) -> int:
    """Which period it is, counted by the monotonic clock."""
    return math.floor(time.monotonic() / period_s)


class Server:
    """Requests to one server. Trays of several threads share it: it is asked once in each period."""

    def __init__(self, config: PrometheusConfig, folder: Path) -> None:
        """folder: relative paths start here."""
        self._config = config
        self._folder = folder
        self._opener: urllib.request.OpenerDirector | None = None
        self._headers: dict[str, str] = {}
        self._lock = threading.Lock()
        self._wanted: dict[tuple[str, ...], dict[Series, None]] = {}
        """series, by the names of their labels"""
        self._asked_in, self._answered_s = -1, time.monotonic()
        self._outcome: Answer | UserError = {}

    def connect(self) -> None:
        """Read the credentials. Raises UserError."""
        config = self._config
        headers: dict[str, str] = {}
        password = config.password(self._folder)
        if password is not None:
            login = base64.b64encode(f"{config.username}:{password}".encode()).decode()
            headers["Authorization"] = f"Basic {login}"
        elif config.token_file:
            headers["Authorization"] = f"Bearer {read_secret(self._folder / config.token_file)}"
        if headers and config.parts.scheme == "http" and not is_of_this_host_only(config.host):
            raise DeviceError(f"{config.host} would get the password in the clear: use https")
        self._headers = headers
        if not self._opener:
            context = client_context(config.ca and self._folder / config.ca, None, None)
            self._opener = urllib.request.build_opener(urllib.request.HTTPSHandler(context=context), _NoRedirect())

    def want(self, series: Iterable[Series]) -> None:
        """Ask for these, too."""
        with self._lock:
            for each in series:
                self._wanted.setdefault(tuple(name for name, _ in each), {})[each] = None
            self._asked_in = -1

    def answer(self) -> Answer:
        """The newest samples of all that is wanted. Raises UserError."""
        with self._lock:
            number = period_number(self._config.period_s)
            if number != self._asked_in:
                self._asked_in = number
                now_s = time.monotonic()
                try:
                    self._outcome = self._asked_for_all(now_s)
                    self._answered_s = now_s
                except UserError as error:
                    self._outcome = error
            if isinstance(self._outcome, UserError):
                raise self._outcome
            return self._outcome

    def _asked_for_all(self, now_s: float) -> Answer:
        period_s = self._config.period_s
        found: dict[Series, list[Samples]] = defaultdict(list)
        if self._config.scrape:
            there = self.shown({dict(series)[NAME] for group in self._wanted.values() for series in group})
            self._sort_out(there, self._wanted, found)
        else:
            back_s = max(MOST_FAILURES * period_s, min(now_s - self._answered_s + period_s, LONGEST_BACK_S))
            for names, group in self._wanted.items():
                there = self.samples(f"{selector_of(names, group)}[{math.ceil(back_s)}s]")
                self._sort_out(there, {names: group}, found)
        return found

    @staticmethod
    def _sort_out(
        there: Iterable[tuple[Labels, Samples]],
        wanted: Mapping[tuple[str, ...], Mapping[Series, None]],
        found: dict[Series, list[Samples]],
    ) -> None:
        for labels, samples in there:
            for names, group in wanted.items():
                series = tuple((name, labels.get(name, "")) for name in names)
                if samples and series in group:
                    found[series].append(samples)

    def samples(self, query: str) -> list[tuple[Labels, Samples]]:
        """The samples of a range query. Raises DeviceError."""
        answer = self._asked("/api/v1/query", urllib.parse.urlencode({"query": query}).encode())
        try:
            data: Any = json.loads(answer)["data"]
            assert data["resultType"] == "matrix"
            return [(each["metric"], [_sample(*pair) for pair in each.get("values", ())]) for each in data["result"]]
        except (ValueError, TypeError, LookupError, AttributeError, AssertionError, RecursionError) as error:
            raise DeviceError("it answers, but not as a Prometheus does: correct source.url") from error

    def shown(self, names: Iterable[str]) -> list[tuple[Labels, Samples]]:
        """What an exporter shows now of the series with these names. A line that cannot be read is left out."""
        begins = tuple(names)
        found: list[tuple[Labels, Samples]] = []
        began_t_ns = HOST_CLOCK.now_ns()
        text = self._asked(self._config.scrape).decode(errors="replace")
        now_t_ns = (began_t_ns + HOST_CLOCK.now_ns()) // 2
        for line in text.splitlines():
            with suppress(ValueError):
                for family in text_string_to_metric_families(line) if line.startswith(begins) else ():
                    for name, labels, value, timestamp, *_ in family.samples:
                        t_ns = round(float(timestamp) * NS_PER_S) if timestamp else now_t_ns
                        found.append(({NAME: name, **labels}, [(t_ns, _finite(float(value)))]))
        return found

    def _asked(self, path: str, body: bytes | None = None) -> bytes:
        """The answer to a request. Raises DeviceError, whose text has no credentials."""
        config = self._config
        host = config.parts.netloc.rpartition("@")[2]
        url = f"{config.parts.scheme}://{host}{config.parts.path.rstrip('/')}{path}"
        assert self._opener
        try:
            with self._opener.open(urllib.request.Request(url, body, self._headers), timeout=TIMEOUT_S) as answer:
                found = answer.read(LARGEST_ANSWER + 1)
        except urllib.error.HTTPError as error:
            with error:
                raise DeviceError(_refusal(error)) from error
        except (OSError, http.client.HTTPException) as error:
            cause = getattr(error, "reason", error)
            if isinstance(cause, ssl.SSLError):
                raise DeviceError(tls_refusal(cause, "server"), is_lost=True) from error
            why = f"does not answer within {TIMEOUT_S:g} s, or cannot be reached"
            raise DeviceError(f"{why}: check source.url; waiting for it", is_lost=True) from error
        if len(found) > LARGEST_ANSWER:
            raise DeviceError(f"its answer is larger than {LARGEST_ANSWER >> 20} MiB: name the series by more labels")
        return found


_servers: WeakValueDictionary[str, Server] = WeakValueDictionary()
_servers_lock = threading.Lock()


def server_of(config: PrometheusConfig, folder: Path) -> Server:
    """The server of this process that a configuration names."""
    key = f"{folder} {config.model_dump_json(exclude={'fan', 'labels'})}"
    with _servers_lock:
        return _servers.setdefault(key, Server(config, folder))


def selector_of(names: Sequence[str], group: Iterable[Series]) -> str:
    """One selector that finds all series of a group, and maybe more: by the values that each label has in it."""
    values = ([*dict.fromkeys(each)] for each in zip(*(dict(series).values() for series in group), strict=True))
    return f"{{{','.join(map(_matcher, names, values))}}}"


def _matcher(name: str, values: Sequence[str]) -> str:
    if len(values) == 1:
        return f"{name}={quoted(values[0])}"
    return f"{name}=~{quoted('|'.join(map(re.escape, values)))}"


def quoted(text: str) -> str:
    """A text as PromQL has it."""
    return json.dumps(text, ensure_ascii=False)


def _sample(t_s: Any, value: Any) -> tuple[int, float]:
    return round(float(t_s) * 1e3) * (NS_PER_S // 1000), _finite(float(value))


def _finite(value: float) -> float:
    return value if math.isfinite(value) else math.nan


def _refusal(error: urllib.error.HTTPError) -> str:
    """Why a request was refused, and what to do."""
    if error.code in (401, 403):
        return "user, password or token is refused, or lacks rights"
    if error.code in (301, 302, 303, 307, 308):
        return "it sends to another address: write that in source.url"
    said = ""
    with suppress(ValueError, TypeError, LookupError, OSError):
        said = f": {json.loads(error.read(4096))['error'][:200]}"
    return f"refused with HTTP status {error.code}{said}; check source.url"


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Credentials go to no other address."""

    def redirect_request(self, *_args: Any, **_kwargs: Any) -> None:
        return None
