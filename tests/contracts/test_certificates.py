"""One list of claims over everything that shows a certificate: what cannot be used is refused in one line."""

from __future__ import annotations

import ssl
from collections.abc import Callable
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    PrivateFormat,
    load_pem_private_key,
)

from fantwin.pipeline import certificates
from fantwin.pipeline.bus.credentials import checked_credentials
from fantwin.pipeline.certificates import client_context, make_self_signed, server_context, tls_refusal
from fantwin.pipeline.config.settings import SecurityConfig
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.opcua.config import OpcuaConfig
from fantwin.pipeline.outputs.web.config import GatewayConfig
from fantwin.pipeline.runtime.stage import Context
from fantwin.pipeline.sources.http.config import HttpConfig
from fantwin.pipeline.sources.http.source import HttpSource
from fantwin.pipeline.sources.mqtt.client import new_client
from fantwin.pipeline.sources.mqtt.connection import BrokerSettings
from fantwin.pipeline.sources.source import SourceContext
from fantwin.stages import gateway, opcua
from tests.support.ports import free_port
from tests.support.site_certificates import SiteCertificates

CERTIFICATE, KEY, CA = "own.pem", "own.key", "ca.pem"
PAIR: dict[str, Any] = {"certificate": Path(CERTIFICATE), "key": Path(KEY)}


def problems_of_bus(folder: Path) -> list[str]:
    try:
        checked_credentials(SecurityConfig(folder=folder), ("own",))
    except UserError as error:
        return [str(error)]
    return []


def problems_of_page(folder: Path) -> list[str]:
    return gateway.check(Context("hall", (), GatewayConfig(**PAIR), folder, folder, 0))


def problems_of_samples(folder: Path) -> list[str]:
    return HttpSource(HttpConfig(port=free_port(), **PAIR), SourceContext(2, "rpm", folder, "tray1", None)).check()


def problems_of_opcua(folder: Path) -> list[str]:
    return opcua.check(Context("hall", (), OpcuaConfig(port=free_port(), **PAIR), folder, folder, 0))


def problems_of_mqtt(folder: Path) -> list[str]:
    try:
        new_client(BrokerSettings(url="mqtts://broker", **PAIR), folder)
    except UserError as error:
        return [str(error)]
    return []


USERS: dict[str, Callable[[Path], list[str]]] = {
    "bus": problems_of_bus,
    "page": problems_of_page,
    "samples over HTTP": problems_of_samples,
    "OPC UA": problems_of_opcua,
    "MQTT": problems_of_mqtt,
}


def add_a_password(folder: Path) -> None:
    key = load_pem_private_key((folder / KEY).read_bytes(), None)
    secret = BestAvailableEncryption(b"secret")
    (folder / KEY).write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, secret))


def let_it_expire(folder: Path) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(certificates, "SELF_SIGNED_LIFETIME", timedelta(seconds=-1))
        make(folder)


HARMS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no certificate": (lambda folder: (folder / CERTIFICATE).unlink(), r"own\.pem: (No such file|no such certificate)"),
    "nonsense": (lambda folder: (folder / CERTIFICATE).write_text("-----BEGIN"), r"own\.pem: no certificate in PEM"),
    "no key": (lambda folder: (folder / KEY).unlink(), r"own\.key: No such file"),
    "nonsense as key": (lambda folder: (folder / KEY).write_text("key"), r"own\.key: no key in PEM or DER"),
    "another key": (
        lambda folder: (folder / "other.key").replace(folder / KEY),
        r"own\.key: not the key of the certificate .*own\.pem",
    ),
    "a password": (add_a_password, r"own\.key: the key has a password, which nobody is asked for"),
    "readable by the group": (
        lambda folder: (folder / KEY).chmod(0o640),
        r"own\.key: others may read this private key: chmod 600",
    ),
    "readable by all": (
        lambda folder: (folder / KEY).chmod(0o604),
        r"own\.key: others may read this private key: chmod 600",
    ),
    "expired": (let_it_expire, r"own\.pem: expired on 20"),
}


def make(folder: Path) -> None:
    """A pair that signs itself, so that it is its own authority; its key is of RSA, which OPC UA needs."""
    for name in (CERTIFICATE, KEY):
        (folder / name).unlink(missing_ok=True)
    make_self_signed(folder / CERTIFICATE, folder / KEY, "own", "urn:fantwin", ("localhost", "127.0.0.1"))
    (folder / CA).write_bytes((folder / CERTIFICATE).read_bytes())


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("made")
    make(folder)
    SiteCertificates(folder / "site").issue("other")
    (folder / "site" / "other.key").replace(folder / "other.key")
    return {name: (folder / name).read_bytes() for name in (CERTIFICATE, KEY, CA, "other.key")}


@pytest.fixture
def folder(tmp_path: Path, made: dict[str, bytes]) -> Path:
    for name, content in made.items():
        (tmp_path / name).write_bytes(content)
        (tmp_path / name).chmod(0o600)
    return tmp_path


@pytest.mark.parametrize("user", USERS)
def test_a_pair_that_fits_is_taken(user: str, folder: Path) -> None:
    assert USERS[user](folder) == []


@pytest.mark.parametrize("user", USERS)
@pytest.mark.parametrize("harm", HARMS)
def test_what_cannot_be_used_is_refused_in_one_line(user: str, harm: str, folder: Path) -> None:
    break_it, why = HARMS[harm]
    break_it(folder)
    (problem,) = USERS[user](folder)
    assert "\n" not in problem
    with pytest.raises(UserError, match=why):
        raise UserError(problem)


@pytest.mark.parametrize(("host", "is_right"), [("localhost", True), ("127.0.0.1", True), ("plant.example", False)])
def test_a_client_takes_its_authority_s_certificate_for_the_host_that_it_names_alone(
    host: str, is_right: bool, folder: Path
) -> None:
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    client = client_context(folder / CA, None, None).wrap_bio(to_client, to_server, server_hostname=host)
    server = server_context(folder / CERTIFICATE, folder / KEY).wrap_bio(to_server, to_client, server_side=True)

    def shake_hands() -> None:
        for _ in range(4):
            for each in (client, server):
                with suppress(ssl.SSLWantReadError):
                    each.do_handshake()

    if is_right:
        shake_hands()
        assert client.cipher()
        return
    with pytest.raises(ssl.SSLCertVerificationError) as refused:
        shake_hands()
    assert "check ca, and that the host is a name in the certificate of the broker" in tls_refusal(
        refused.value, "broker"
    )
