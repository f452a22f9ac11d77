"""What can be wrong with an endpoint, or several, before any process uses it."""

from __future__ import annotations

import ipaddress
import re
import socket

from fantwin.pipeline.bus.errors import BusError
from fantwin.pipeline.config.settings import BETWEEN_ENDPOINTS, BusConfig

_ADDRESS = re.compile(r"(tcp|tls|ws|udp|quic)/(\[[^\]]*\]|[^:/?#]*):(\d+)(?:[?#].*)?")
_CONNECTING = ("tcp", "tls", "ws")
_WITHIN_HOST = ("unixsock-stream", "unixpipe")
"""schemes of endpoints that are files of a host"""
_CONNECT_TIMEOUT_S = 1.0


def endpoint_problem(endpoint: str) -> str:
    """What is wrong with an endpoint in itself: one line, or empty. Zenoh checks all but host and port.

    A host that does not resolve now may do so later, as that of a container that has not started yet.
    """
    return next(filter(None, map(_problem, endpoint.split(BETWEEN_ENDPOINTS))), "")


def somebody_listens(endpoint: str) -> bool:
    """Whether the port is taken on this host; also true for an address of another host.

    It binds and does not connect: the other end would take a connection for a peer.
    """
    return any(map(_is_taken, _addresses(endpoint)))


def accepts_connections(endpoint: str) -> bool:
    """Whether a program accepts connections there, whatever it is."""
    return any(map(_accepts, _addresses(endpoint)))


def _problem(endpoint: str) -> str:
    match = _ADDRESS.fullmatch(endpoint)
    if match is None:
        return ""
    if not (match[3].isascii() and 1 <= int(match[3][:6]) <= 65535):
        return f"bus.endpoint = {endpoint!r}: port {match[3][:20]} is out of range, 1 to 65535"
    try:
        socket.getaddrinfo(match[2].strip("[]"), int(match[3]))
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a host name"
        return f"bus.endpoint = {endpoint!r}: the host {match[2]!r} cannot be found ({reason}): correct it"
    return ""


def _addresses(endpoint: str) -> list[re.Match[str]]:
    """Those of the endpoints at which a program can be connected to."""
    found = filter(None, map(_ADDRESS.fullmatch, endpoint.split(BETWEEN_ENDPOINTS)))
    return [match for match in found if match[1] in _CONNECTING]


def _is_taken(match: re.Match[str]) -> bool:
    for family, kind, protocol, _, address in _resolved(match):
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(address)
            except OSError:
                return True
    return False


def _accepts(match: re.Match[str]) -> bool:
    try:
        with socket.create_connection((match[2].strip("[]"), int(match[3])), _CONNECT_TIMEOUT_S):
            return True
    except OSError:
        return False


def _speaks_tls(match: re.Match[str]) -> bool:
    """Whether the program there takes part in TLS: it shows a certificate, whoever signed it."""
    import ssl  # noqa: PLC0415  takes a moment, and only who cannot connect needs it

    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    try:
        with (
            socket.create_connection((match[2].strip("[]"), int(match[3])), _CONNECT_TIMEOUT_S) as connection,
            context.wrap_socket(connection),
        ):
            return True
    except OSError:
        return False


def is_beyond_loopback(endpoint: str) -> bool:
    """Whether other hosts or containers may reach an endpoint: it is on a network, and not only of this host. A host
    name that cannot be found now, and an address of another form, count as those of others. What is no endpoint, Zenoh
    refuses."""
    match = _ADDRESS.fullmatch(endpoint)
    if match is None:
        scheme, slash, _ = endpoint.partition("/")
        return bool(slash) and scheme not in _WITHIN_HOST
    try:
        found = socket.getaddrinfo(match[2].strip("[]"), int(match[3][:5]))
    except (OSError, UnicodeError):
        return True
    return not all(ipaddress.ip_address(str(each[4][0]).partition("%")[0]).is_loopback for each in found)


def require_tls_with_security(config: BusConfig) -> None:
    """Raises BusError if an endpoint has TLS without `bus.security`, or the other way round."""
    for endpoint in config.endpoints:
        scheme, _, place = endpoint.partition("/")
        if config.security and scheme != "tls":
            raise BusError(f"bus.endpoint = {endpoint!r}: with [bus.security] write tls/{place}")
        if not config.security and scheme in ("tls", "quic"):
            raise BusError(
                f"bus.endpoint = {endpoint!r}: {scheme} needs certificates: write a section [bus.security], see "
                "`fantwin certs --help`"
            )


def foreign_program(endpoint: str, *, is_secure: bool) -> str:
    """One line about an endpoint that accepts connections and does not answer as fantwin.

    is_secure: with `bus.security`; the other end does not say why it refuses.
    """
    has_tls = any(map(_speaks_tls, _addresses(endpoint)))
    if is_secure and has_tls:
        return (
            f"bus.endpoint = {endpoint!r}: what listens there has a certificate of another authority or without "
            "this host name, or is not fantwin: see `fantwin certs show` there and here"
        )
    if is_secure:
        return (
            f"bus.endpoint = {endpoint!r}: the program that listens there takes no TLS: it has no [bus.security], is "
            "not fantwin, or hangs"
        )
    if has_tls:
        return (
            f"bus.endpoint = {endpoint!r}: the program that listens there takes TLS only: give this configuration the "
            "section [bus.security] and an endpoint tls/HOST:PORT, see `fantwin certs --help`"
        )
    return (
        f"bus.endpoint = {endpoint!r}: the program that listens there is not fantwin, or hangs, so stages cannot "
        "connect: stop it, or choose another port"
    )


def _resolved(match: re.Match[str]) -> list[tuple[int, int, int, str, tuple[object, ...]]]:
    try:
        found = socket.getaddrinfo(match[2].strip("[]"), int(match[3]), type=socket.SOCK_STREAM)
    except OSError:
        return []
    return [(int(family), int(kind), protocol, name, address) for family, kind, protocol, name, address in found]
