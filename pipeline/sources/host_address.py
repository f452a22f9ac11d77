"""Addresses to listen on."""

from __future__ import annotations

import ipaddress


def is_of_this_host_only(host: str) -> bool:
    """Return whether only this host can reach a server at that address."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"
