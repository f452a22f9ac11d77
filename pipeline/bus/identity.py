"""Identity on the bus: the certificate that a process shows, and the id of its Zenoh session, with which the names of
its producers end.

The common name of a certificate is a role, as `scorer` or `acquisition.tray1` (`pipeline.config.roles`).

Zenoh marks each message and each answer with the id of the session that sent it. So a message in the name of another
session is known by itself, without asking anybody, and is refused. A program that also forges Zenoh's mark is kept away
by certificates only (docs/how-to/security.md).
"""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import zenoh

from fantwin.pipeline.bus.errors import BusError
from fantwin.pipeline.certificates import Certificate, check_pair, read_certificate, require_valid
from fantwin.pipeline.config.settings import SecurityConfig
from fantwin.pipeline.errors import UserError
from fantwin.schemas.codec import CodecError, decode_header
from fantwin.schemas.topics import key_in_words, topic_of


@dataclass(frozen=True)
class Credentials:
    """The files that a process uses, checked, and what its certificate and that of its authority say."""

    ca: Path
    certificate: Path
    key: Path
    own: Certificate
    authority: Certificate

    @property
    def role(self) -> str:
        """The role that the certificate gives its owner."""
        return self.own.role

    def warning(self) -> str:
        """Say that a certificate expires soon or has expired; else empty."""
        return warning(self.own) or warning(self.authority)


def checked_credentials(security: SecurityConfig, roles: Sequence[str]) -> Credentials:
    """The files of a process, of the first of these roles that has a certificate here.

    Raises:
        BusError: a file is missing or cannot be used: one line that says which, why, and what to do.
    """
    places = {role: security.certificate(role) for role in roles}
    role = next((each for each, path in places.items() if path.exists()), "")
    if not role:
        names = " or ".join(map(str, dict.fromkeys(places.values())))
        raise BusError(f"{names}: no such certificate: `fantwin certs issue` makes it")
    ca, certificate, key = security.ca, security.certificate(role), security.key(role)
    try:
        own, authority = check_pair(certificate, key, ca), read_certificate(ca)
    except UserError as error:
        raise BusError(str(error)) from error
    for each in (own, authority):
        if not each.role:
            raise BusError(f"{each.path}: a certificate without a common name, which would name its role")
        try:
            require_valid(each)
        except UserError as error:
            raise BusError(f"{error}: {_renewal(each)}") from error
    return Credentials(ca, certificate, key, own, authority)


def warning(certificate: Certificate) -> str:
    """Say that a certificate of the bus expires soon or may not be used, and what renews it; else empty."""
    found = certificate.warning(datetime.now(UTC))
    return f"{found}: {_renewal(certificate)}" if found else ""


def _renewal(certificate: Certificate) -> str:
    if certificate.is_authority:
        return "`fantwin certs init --replace` makes a new authority, and `issue --replace` new certificates"
    return f"`fantwin certs renew {certificate.role}`, and restart its process"


SHOWN_S = 60.0
"""how long health names the last forged message"""
_DIGITS = 16
_NAMES_SESSION = re.compile(rf".*-([1-9a-f][0-9a-f]{{{_DIGITS - 1}}})", re.DOTALL)


def new_session_id() -> str:
    """A random id for a Zenoh session. Zenoh takes no leading zero."""
    return "f" + secrets.token_hex(_DIGITS // 2)[1:]


def names_another(producer: str, session_id: str) -> bool:
    """Whether the name of a producer is that of another session. A name without an id may be anybody's."""
    match = _NAMES_SESSION.fullmatch(producer)
    return match is not None and match[1] != session_id


def sender_of(sample: zenoh.Sample) -> str:
    """The id of the session that published a message; empty if it carries none."""
    info = sample.source_info
    return str(info.source_id.zid) if info else ""


def answerer_of(reply: zenoh.Reply) -> str:
    """The id of the session that has answered; empty if the answer carries none."""
    answerer = reply.replier_id
    return str(answerer.zid) if answerer else ""


class Forgeries:
    """Finds and counts messages whose producer is not the session that sent them."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self.count = 0
        self._now_s = now_s
        self._last, self._seen_s = "", 0.0

    def is_one(self, key: str, payload: bytes, session_id: str) -> bool:
        """Whether a message on this key is in the name of another session than sent it; it is then counted. One that
        cannot be read is in nobody's name."""
        try:
            producer = str(decode_header(topic_of(key).message, payload).producer)
        except (KeyError, CodecError):
            return False
        if not names_another(producer, session_id):
            return False
        self.count += 1
        self._last, self._seen_s = f"{key_in_words(key)} in the name of {producer}", self._now_s()
        return True

    def problem(self) -> str:
        """The last forged message, while it is recent; empty if there is none."""
        if not self._last or self._now_s() - self._seen_s >= SHOWN_S:
            return ""
        return f"another program publishes {self._last}: refused; stop that program"
