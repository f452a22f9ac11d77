"""The OPC UA stage: who connects, and what survives a restart. Clients are those of the same library."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

import asyncio
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("asyncua")

from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from cryptography import x509

from fantwin.pipeline.certificates import make_self_signed
from fantwin.pipeline.outputs.opcua.config import OpcuaConfig
from fantwin.pipeline.runtime.stage import Context
from fantwin.pipeline.site.users import UserRole
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm, Request
from fantwin.stages.opcua import check
from tests.support.running_core import SITE, TRAY
from tests.support.running_opcua import RunningOpcua
from tests.support.site_messages import alarm, score
from tests.support.site_users import OPERATOR, PASSWORD, VIEWER, make_users

pytestmark = pytest.mark.usefixtures("quickly_hashed")
ALARM = f"ns=2;s={TRAY}/2/Alarm"
REMOVE_FROM_SERVICE = ua.NodeId(ua.ObjectIds.AlarmConditionType_RemoveFromService)

UNHEARD = "unheard"
"""whom the scorer does not answer"""
USERS = dict.fromkeys((OPERATOR, "changes", "guessed", UNHEARD), UserRole.OPERATOR)


class Heard:
    """Takes events."""

    def event_notification(self, event: Any) -> None:
        """Do nothing with it."""


@pytest.fixture(scope="module")
def opcua(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningOpcua]:
    """One for all tests that do not end it; who changes a user has one of his own."""
    removed = alarm(Transition.OUT_OF_SERVICE, out_of_service=True)
    running = RunningOpcua(
        tmp_path_factory.mktemp("site"), lambda asked: [] if asked.operator_name == UNHEARD else [removed]
    )
    running.feed(score(), alarm())
    make_users(running.users, **USERS)
    try:
        yield running
    finally:
        running.close()


async def encrypted(running: RunningOpcua, folder: Path, user: str, password: str = PASSWORD) -> Client:
    """A client that is logged in."""
    certificate, key = folder / "client.der", folder / "client.pem"
    client = Client(running.url, timeout=60)
    make_self_signed(certificate, key, "client", client.application_uri, ("localhost",))
    client.set_user(user)
    client.set_password(password)
    await client.set_security(SecurityPolicyBasic256Sha256, str(certificate), str(key))
    await client.connect()
    return client


async def status_of_removal(client: Client) -> str:
    request = ua.CallMethodRequest(ObjectId=ua.NodeId.from_string(ALARM), MethodId=REMOVE_FROM_SERVICE)
    (result,) = await client.uaclient.call([request])
    return result.StatusCode.name


def test_a_session_ends_with_the_password_that_began_it(opcua, tmp_path):
    async def session() -> None:
        client = await encrypted(opcua, tmp_path, "changes")
        assert await status_of_removal(client) == "Good"
        make_users(opcua.users, "another horse battery", changes=UserRole.OPERATOR)
        assert await status_of_removal(client) == "BadUserAccessDenied"
        make_users(opcua.users, **USERS)
        await client.disconnect()

    asyncio.run(session())
    (sent,) = (each for each in opcua.sent if each.operator_name == "changes")
    assert sent.fan == 2, "under the name that has logged in"


def test_a_scorer_that_does_not_answer_is_a_timeout_and_others_are_served_meanwhile(opcua, tmp_path, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.site.request_desk.ANSWERED_WITHIN_S", 2.0)

    async def acts() -> tuple[str, str]:
        client = await encrypted(opcua, tmp_path, UNHEARD)
        async with Client(opcua.url, timeout=60) as other:
            waiting = asyncio.create_task(status_of_removal(client))
            while not any(asked.operator_name == UNHEARD for asked in opcua.sent):
                await asyncio.sleep(0.01)
            message = await other.get_node(f"{ALARM}/Message").read_value()
            assert not waiting.done()
            status = await waiting
        await client.disconnect()
        return status, message.Text

    status, message = asyncio.run(acts())
    assert status == "BadTimeout"
    assert message.startswith("fan 2: 90 rpm")


def test_an_attribute_that_there_is_not_fails_alone_and_a_short_queue_that_is_asked_for_later_drops_no_event(opcua):
    async def reads() -> list[str]:
        async with Client(opcua.url, timeout=60) as client:
            node = client.get_node(f"{ALARM}/Message").nodeid
            wanted = [ua.ReadValueId(node, ua.UInt32(attribute)) for attribute in (99, ua.AttributeIds.Value)]
            found = await client.uaclient.read(ua.ReadParameters(NodesToRead=wanted))
            subscription = await client.create_subscription(100, Heard())
            number = await subscription.subscribe_events(client.nodes.server)
            item = ua.MonitoredItemModifyRequest(
                MonitoredItemId=number, RequestedParameters=ua.MonitoringParameters(QueueSize=1)
            )
            changed = await client.uaclient.modify_monitored_items(
                ua.ModifyMonitoredItemsParameters(subscription.subscription_id, ItemsToModify=[item])
            )
            statuses = [each.StatusCode.name for each in found if each.StatusCode]
            return [*statuses, str(changed[0].RevisedQueueSize)]

    assert asyncio.run(reads()) == ["BadAttributeIdInvalid", "Good", "10000"]


def check_that_only_trusted_clients_connect(running: RunningOpcua, folder: Path, capfd: Any) -> None:
    async def connects() -> None:
        client = await encrypted(running, folder, VIEWER)
        await client.disconnect()

    with pytest.raises(ua.UaStatusCodeError) as refused:
        asyncio.run(connects())
    assert refused.value.code == ua.StatusCodes.BadCertificateUntrusted
    assert "client refused: its certificate is not in the folder `trusted`" in capfd.readouterr().err
    (folder / "trusted" / "client.der").write_bytes((folder / "client.der").read_bytes())
    asyncio.run(connects())


def test_wrong_passwords_are_counted(opcua, tmp_path):
    async def log_in(password: str) -> bool:
        try:
            client = await encrypted(opcua, tmp_path, "guessed", password)
        except ua.UaStatusCodeError:
            return False
        await client.disconnect()
        return True

    assert [asyncio.run(log_in("wrong wrong wrong")) for _ in range(5)] == [False] * 5
    assert not asyncio.run(log_in(PASSWORD)), "not even with the right one, for a minute"


def test_a_session_cannot_be_guessed_and_nobody_refreshes_the_subscription_of_another(opcua):
    class Ignores:
        def event_notification(self, event: Any) -> None: ...

    async def tries() -> tuple[str, int]:
        async with Client(opcua.url, timeout=60) as one, Client(opcua.url, timeout=60) as other:
            subscription = await one.create_subscription(500, Ignores())
            refresh = ua.CallMethodRequest(
                ObjectId=ua.NodeId(ua.ObjectIds.ConditionType),
                MethodId=ua.NodeId(ua.ObjectIds.ConditionType_ConditionRefresh),
                InputArguments=[ua.Variant(subscription.subscription_id, ua.VariantType.UInt32)],
            )
            (of_another,) = await other.uaclient.call([refresh])
            token = one.uaclient.protocol.authentication_token  # type: ignore[union-attr]
            return of_another.StatusCode.name, len(token.Identifier)

    assert asyncio.run(tries()) == ("BadSubscriptionIdInvalid", 32)


def test_only_trusted_clients_connect_encrypted_and_history_certificate_and_events_survive_a_restart(tmp_path, capfd):
    (tmp_path / "trusted").mkdir()
    first = RunningOpcua(tmp_path, trusted=tmp_path / "trusted")
    first.feed(alarm(), alarm(Transition.SEVERITY, 1))
    check_that_only_trusted_clients_connect(first, tmp_path, capfd)
    certificate = (tmp_path / "opcua-certificate.der").read_bytes()
    first.close()
    asked: list[Request] = []

    def answer(request: Request) -> list[Alarm]:
        asked.append(request)
        return [alarm(Transition.ACKNOWLEDGED, acknowledged=True)]

    second = RunningOpcua(tmp_path, answer)
    try:
        assert (tmp_path / "opcua-certificate.der").read_bytes() == certificate
        assert (tmp_path / "opcua-key.pem").stat().st_mode & 0o077 == 0
        second.feed(alarm(Transition.SEVERITY, 1))

        async def acknowledges() -> tuple[int, str]:
            client = await encrypted(second, tmp_path, OPERATOR)
            node = client.get_node(ua.NodeId(ua.ObjectIds.Server))
            past = await node.read_event_history(datetime(2020, 1, 1, tzinfo=UTC), datetime(2100, 1, 1, tzinfo=UTC))
            event = ua.Variant(past[0].__dict__["EventId"], ua.VariantType.ByteString)
            comment = ua.Variant(ua.LocalizedText("seen"), ua.VariantType.LocalizedText)
            request = ua.CallMethodRequest(
                ObjectId=ua.NodeId.from_string(ALARM),
                MethodId=ua.NodeId(ua.ObjectIds.AcknowledgeableConditionType_Acknowledge),
                InputArguments=[event, comment],
            )
            (result,) = await client.uaclient.call([request])
            await client.disconnect()
            return len(past), result.StatusCode.name

        assert asyncio.run(acknowledges()) == (2, "Good"), "by the event that was sent before the restart"
        assert asked[0].comment == "seen"
    finally:
        second.close()


def test_the_certificate_that_it_makes_is_one_for_opc_ua_and_the_check_names_what_is_wrong(opcua, tmp_path):
    certificate, key = tmp_path / "c.der", tmp_path / "k.pem"
    make_self_signed(certificate, key, "server", "urn:here:fantwin:hall", ("localhost", "127.0.0.1", "plant.example"))
    found = x509.load_der_x509_certificate(certificate.read_bytes())
    names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.UniformResourceIdentifier) == ["urn:here:fantwin:hall"]
    assert "plant.example" in names.get_values_for_type(x509.DNSName)
    usage = found.extensions.get_extension_for_class(x509.KeyUsage).value
    assert usage.digital_signature and usage.data_encipherment
    config = OpcuaConfig(port=opcua.port, certificate=Path("no.der"), key=Path("no.pem"))
    problems = check(Context(SITE, (), config, tmp_path, tmp_path, 0))
    assert [each.split()[0] for each in problems] == [f"{tmp_path / 'no.der'}:", "opcua.host"], "its port is taken"
