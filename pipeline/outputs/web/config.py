"""Section `[gateway]`."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator, model_validator

from fantwin.pipeline.runtime.stage import StageConfig
from fantwin.pipeline.sources.host_address import is_of_this_host_only

_OWN_HOSTS = ("localhost", "127.0.0.1", "[::1]")


class GatewayConfig(StageConfig):
    """Where the page is served, and who may see it and act.

    Beyond loopback it needs TLS, and users or a proxy that knows them.
    """

    host: str = Field(default="127.0.0.1", description="address to listen on")
    port: int = Field(
        default=8080,
        ge=1,
        le=65535,
        description="port; if it is not set and 8080 is taken, `fantwin up` chooses the next free one; shard K uses "
        "the K-th from here on",
    )
    certificate: Path | None = Field(default=None, description="PEM file: serve https with this certificate")
    key: Path | None = Field(default=None, description="PEM file: its private key")
    users: Path | None = Field(
        default=None, description="file of users, written by `fantwin users`; without it nobody can act from the page"
    )
    user_header: str = Field(
        default="",
        pattern=r"^[A-Za-z0-9-]*$",
        description='header in which a proxy passes the name of the user it has authenticated; "": none',
    )
    proxies: tuple[str, ...] = Field(
        default=("127.0.0.1", "::1"), description="addresses of that proxy; the header is refused from any other"
    )
    operators: tuple[str, ...] = Field(
        default=(), description="users of the proxy who may act; all others may only view"
    )
    hosts: tuple[str, ...] = Field(
        default=(),
        description="names, besides localhost and its addresses, under which browsers may request the page on "
        'loopback, such as the name of a proxy; "*": any',
    )

    in_front: Literal["", "loopback", "tls"] = Field(
        default="",
        description='what is between people and a host beyond loopback. "loopback": its port is published on the '
        'loopback of a host alone, as from a container; "tls": a proxy ends TLS, such as an Ingress',
    )

    @property
    def is_loopback(self) -> bool:
        """Whether only this host reaches it."""
        return is_of_this_host_only(self.host) or self.in_front == "loopback"

    @property
    def is_https(self) -> bool:
        """Whether browsers reach it by https."""
        return self.certificate is not None or self.in_front == "tls"

    @property
    def known_hosts(self) -> frozenset[str]:
        """All names under which browsers may ask for the page; with "*", under any."""
        return frozenset((*_OWN_HOSTS, *self.hosts)) if self.is_loopback else frozenset("*")

    @property
    def has_other_hosts(self) -> bool:
        """Whether browsers ask for the page by another name than that of loopback, so through a proxy."""
        return not set(self.hosts) <= set(_OWN_HOSTS)

    @field_validator("proxies")
    @classmethod
    def _are_addresses(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        try:
            return tuple(str(ipaddress.ip_address(each.strip("[]"))) for each in value)
        except ValueError as error:
            raise ValueError(f"{error}: give the address of the proxy, not its name") from error

    @model_validator(mode="after")
    def _check(self) -> GatewayConfig:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together: give both, or none")
        if self.user_header and self.users:
            raise ValueError("users and user_header exclude each other: users are known to this file or to a proxy")
        if self.operators and not self.user_header:
            raise ValueError("operators are users of a proxy: they need user_header")
        if not self.is_loopback:
            if not self.is_https:
                raise ValueError(f"host {self.host} is beyond loopback: that needs certificate and key")
            if not (self.users or self.user_header):
                raise ValueError(
                    f"host {self.host} is beyond loopback: that needs users (`fantwin users add NAME`), or a proxy's "
                    "user_header"
                )
        return self
