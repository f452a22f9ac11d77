"""An SNMP agent on loopback with the objects that a test gives it: version 2c, and 3 with a user."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pysnmp.carrier.asyncio.dgram import udp
from pysnmp.entity import config, engine
from pysnmp.entity.rfc3413 import cmdrsp, context
from pysnmp.proto.api import v2c
from pysnmp.smi import instrum

COMMUNITY, USER, PASSWORD, PRIVACY = "fans-of-hall-3", "ann", "correct-horse", "battery-staple"


class Agent(instrum.AbstractMibInstrumController):
    """Objects by their identifiers: numbers, or texts."""

    def __init__(self) -> None:
        self.objects: dict[str, int | str] = {}
        self.port = 0

    def read_variables(self, *bindings: Any, **_context: Any) -> Any:
        """The values that are asked for."""
        return [(oid, self._value(".".join(map(str, oid)))) for oid, _ in bindings]

    def read_next_variables(self, *bindings: Any, **_context: Any) -> Any:
        """The objects that follow those that are asked for."""
        numbers = sorted(tuple(map(int, oid.split("."))) for oid in self.objects)
        following = [next((each for each in numbers if each > tuple(oid)), None) for oid, _ in bindings]
        return [
            (v2c.ObjectIdentifier(each), self._value(".".join(map(str, each)))) if each else (oid, v2c.EndOfMibView())
            for each, (oid, _) in zip(following, bindings, strict=True)
        ]

    def _value(self, oid: str) -> Any:
        value = self.objects.get(oid)
        if value is None:
            return v2c.NoSuchInstance()
        return v2c.Integer32(value) if isinstance(value, int) else v2c.OctetString(value)


@contextmanager
def snmp_agent(agent: Agent, port: int) -> Iterator[None]:
    """Serve it on a port."""
    loop = asyncio.new_event_loop()
    is_ready, ends = threading.Event(), asyncio.Event()

    async def serve() -> None:
        served = engine.SnmpEngine()
        config.add_transport(served, udp.DOMAIN_NAME, udp.UdpTransport().open_server_mode(("127.0.0.1", port)))
        config.add_v1_system(served, "area", COMMUNITY)
        config.add_vacm_user(served, 2, "area", "noAuthNoPriv", (1, 3, 6), (1, 3, 6))
        config.add_v3_user(served, USER, config.USM_AUTH_HMAC96_SHA, PASSWORD, config.USM_PRIV_CFB128_AES, PRIVACY)
        config.add_vacm_user(served, 3, USER, "authPriv", (1, 3, 6), (1, 3, 6))
        there = context.SnmpContext(served)
        there.unregister_context_name(b"")
        there.register_context_name(b"", agent)  # pyright: ignore[reportArgumentType]
        cmdrsp.GetCommandResponder(served, there)
        cmdrsp.BulkCommandResponder(served, there)
        await asyncio.sleep(0)  # the transport opens its socket
        is_ready.set()
        await ends.wait()
        served.close_dispatcher()
        await asyncio.sleep(0)

    thread = threading.Thread(target=loop.run_until_complete, args=(serve(),))
    thread.start()
    is_ready.wait(10.0)
    try:
        yield
    finally:
        loop.call_soon_threadsafe(ends.set)
        thread.join(5.0)
        loop.close()
