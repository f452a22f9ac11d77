"""A client of an MQTT broker (paho), with its user, its password and TLS, that connects again with growing delays."""

from __future__ import annotations

import ssl
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fantwin.pipeline.sources.mqtt.connection import KEEPALIVE_S, BrokerSettings

if TYPE_CHECKING:
    from paho.mqtt.client import Client

RECONNECT_DELAY_S, RECONNECT_DELAY_MAX_S = 1, 10
ANSWER_S = 5.0
"""longest wait for the answer to a check"""
NOT_REACHED = "the broker cannot be reached; check url, and whether the broker runs"


def refusal(reason: object) -> str:
    """The line about a broker that does not let this client in."""
    return f"the broker refuses this client: {reason}; check user and password"


def new_client(settings: BrokerSettings, folder: Path, client_id: str = "", *, is_kept: bool = False) -> Client:
    """A client that is not connected yet.

    folder: relative paths start here. client_id: the broker ends an older connection of the same one. is_kept: the
    broker keeps what comes while the client is away; needs client_id.

    Raises:
        UserError: a password or certificate cannot be read.
    """
    from paho.mqtt import client as paho  # noqa: PLC0415  an extra
    from paho.mqtt.enums import CallbackAPIVersion  # noqa: PLC0415

    client = paho.Client(CallbackAPIVersion.VERSION2, client_id, clean_session=not is_kept, protocol=paho.MQTTv311)
    client.reconnect_delay_set(RECONNECT_DELAY_S, RECONNECT_DELAY_MAX_S)
    if settings.username:
        client.username_pw_set(settings.username, settings.password(folder))
    if settings.tls:
        from fantwin.pipeline.certificates import client_context  # noqa: PLC0415  slow to import

        files = (path and folder / path for path in (settings.ca, settings.certificate, settings.key))
        client.tls_set_context(client_context(*files))
    return client


def connection_problems(client: Client, settings: BrokerSettings, name: str) -> list[str]:
    """Problems of a new client that the broker does not answer or accept, one line each; the client is not used
    afterwards.

    name: of the connection, with which each line begins.
    """
    problems: list[str] = []
    has_answered = threading.Event()

    def on_connect(_client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            problems.append(f"{name}: the broker refuses: {reason}; check user and password")
        has_answered.set()

    client.on_connect = on_connect
    try:
        client.connect(settings.host, settings.port, keepalive=KEEPALIVE_S)
    except ssl.SSLError as error:
        from fantwin.pipeline.certificates import tls_refusal  # noqa: PLC0415  slow to import

        return [f"{name}: {tls_refusal(error, 'broker')}"]
    except OSError as error:
        return [f"{name}: cannot be reached: {error.strerror or error}; check url"]
    client.loop_start()
    if not has_answered.wait(ANSWER_S):
        problems.append(f"{name}: what listens there does not answer as a broker; check url")
    client.disconnect()
    client.loop_stop()
    return problems
