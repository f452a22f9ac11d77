"""Fans of an SNMP agent: one request for some objects at once. Nothing is written."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from fantwin.pipeline.errors import refusals
from fantwin.pipeline.extras import require
from fantwin.pipeline.sources.named_values import NamedValuesSource
from fantwin.pipeline.sources.own_json import number_of
from fantwin.pipeline.sources.polling import DeviceError
from fantwin.pipeline.sources.secret_file import read_secret
from fantwin.pipeline.sources.snmp.config import SnmpConfig
from fantwin.pipeline.sources.source import Reading, SourceContext

if TYPE_CHECKING:
    from pysnmp.entity.engine import SnmpEngine

TIMEOUT_S, RETRIES = 1.0, 1
MOST_AT_ONCE = 24
"""objects in a request: an answer has to fit into a datagram"""
MOST_ROWS = 10_000
"""rows of a table that is walked"""
_AUTHENTICATION = {
    "MD5": "usmHMACMD5AuthProtocol",
    "SHA": "usmHMACSHAAuthProtocol",
    "SHA-224": "usmHMAC128SHA224AuthProtocol",
    "SHA-256": "usmHMAC192SHA256AuthProtocol",
    "SHA-384": "usmHMAC256SHA384AuthProtocol",
    "SHA-512": "usmHMAC384SHA512AuthProtocol",
}
_PRIVACY = {
    "DES": "usmDESPrivProtocol",
    "AES": "usmAesCfb128Protocol",
    "AES-192": "usmAesCfb192Protocol",
    "AES-256": "usmAesCfb256Protocol",
}


class _Agent(NamedTuple):
    """What requests to an agent need; credentials and address as pysnmp has them."""

    loop: asyncio.AbstractEventLoop
    engine: SnmpEngine
    credentials: Any
    address: Any


class SnmpSource(NamedValuesSource):
    """A `SampleSource`."""

    def __init__(self, config: SnmpConfig, context: SourceContext) -> None:
        """Raises UserError if the extra is missing."""
        super().__init__(config, context)
        require("source snmp", "devices", "pysnmp")
        self._config = config
        self._agent: _Agent | None = None

    @property
    def name(self) -> str:
        """The agent."""
        return f"snmp {self._config.host}"

    def connect(self) -> None:
        """Read the credentials, and find the address. Whether the agent answers is seen when it is read."""
        from pysnmp.error import PySnmpError  # noqa: PLC0415  an extra, slow to import
        from pysnmp.hlapi.v3arch import asyncio as snmp  # noqa: PLC0415

        credentials = self._credentials(snmp)
        loop = asyncio.new_event_loop()

        async def opened() -> tuple[Any, Any]:
            target = snmp.UdpTransportTarget
            return snmp.SnmpEngine(), await target.create(self._config.address, timeout=TIMEOUT_S, retries=RETRIES)

        try:
            engine, address = loop.run_until_complete(opened())
        except PySnmpError as error:
            loop.close()
            raise DeviceError("its address is not known here: check source.host; waiting for it") from error
        self._agent = _Agent(loop, engine, credentials, address)

    def read(self) -> Reading:
        """Speeds, commands and channels of the fans."""
        values: dict[str, float] = {}
        names = self.names()
        for first in range(0, len(names), MOST_AT_ONCE):
            values |= self._asked(names[first : first + MOST_AT_ONCE])
        return self.reading(values, "snmpwalk shows what there is; correct source.fan")

    def walk(self, column: str) -> dict[str, str]:
        """What is in a column of a table, as text by index. Raises DeviceError."""
        from pysnmp.hlapi.v3arch import asyncio as snmp  # noqa: PLC0415

        agent = self._agent
        assert agent

        async def walked() -> dict[str, str]:
            found: dict[str, str] = {}
            first = snmp.ObjectType(snmp.ObjectIdentity(column))
            asked = agent.engine, agent.credentials, agent.address, snmp.ContextData(), 0, MOST_AT_ONCE, first
            async for failure, _, _, answer in snmp.bulk_walk_cmd(*asked, lookupMib=False, lexicographicMode=False):
                if failure:
                    raise self._unanswered(failure)
                if len(found) > MOST_ROWS:
                    raise DeviceError(f"a table of more than {MOST_ROWS:,} rows: name objects by source.fan")
                found |= {str(oid).removeprefix(f"{column}."): value.prettyPrint() for oid, value in answer}
            return found

        return agent.loop.run_until_complete(walked())

    def disconnect(self) -> None:
        """Close the socket."""
        agent, self._agent = self._agent, None
        if agent:
            agent.loop.call_soon(agent.engine.close_dispatcher)
            agent.loop.run_until_complete(asyncio.sleep(0))
            agent.loop.close()

    def check(self) -> list[str]:
        """Problems before the start: a secret cannot be read. The agent is not asked."""
        files = (self._config.community_file, self._config.password_file, self._config.privacy_file)
        return refusals(*(lambda file=file: self._secret(file) for file in files if file))

    def _secret(self, file: Path | None) -> str | None:
        return read_secret(self._folder / file) if file else None

    def _credentials(self, snmp: Any) -> Any:
        config = self._config
        if config.community_file:
            return snmp.CommunityData(self._secret(config.community_file), mpModel=1)
        privacy = self._secret(config.privacy_file)
        authentication, _, encryption = config.protocols.partition(" ")
        return snmp.UsmUserData(
            config.user,
            authKey=self._secret(config.password_file),
            privKey=privacy,
            authProtocol=getattr(snmp, _AUTHENTICATION[authentication]),
            privProtocol=getattr(snmp, _PRIVACY[encryption or "AES"]) if privacy else snmp.usmNoPrivProtocol,
        )

    def _unanswered(self, failure: object) -> DeviceError:
        who = "community" if self._config.community_file else "user and passwords"
        return DeviceError(f"{failure}: check source.host and its {who}; waiting for it", is_lost=True)

    def _asked(self, oids: Sequence[str]) -> dict[str, float]:
        """The numbers of objects, NaN where there is none. Raises DeviceError."""
        from pysnmp.hlapi.v3arch import asyncio as snmp  # noqa: PLC0415

        agent = self._agent
        assert agent
        bound = [snmp.ObjectType(snmp.ObjectIdentity(oid.lstrip("."))) for oid in oids]
        asking = snmp.get_cmd(
            agent.engine, agent.credentials, agent.address, snmp.ContextData(), *bound, lookupMib=False
        )
        failure, status, _, answer = agent.loop.run_until_complete(asking)
        if failure:
            raise self._unanswered(failure)
        if status:
            raise DeviceError(f"it answers with error {getattr(status, 'prettyPrint', lambda: status)()}")
        return {oid: _number(value) for oid, (_, value) in zip(oids, answer, strict=True)}


def _number(value: Any) -> float:
    """The number in an object; NaN for one that is not there, or is no number."""
    try:
        return float(int(value))
    except (TypeError, ValueError):
        text = bytes(value).decode(errors="replace") if hasattr(value, "__bytes__") else ""
        number = number_of(text)
        return math.nan if number is None else number
