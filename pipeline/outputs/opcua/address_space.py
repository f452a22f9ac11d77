"""The address space: what exists once, which is types and the folder of the site, and the nodes of fans."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

from asyncua import Node, Server, ua
from asyncua.server.address_space import AddressSpace

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.opcua.encoding import (
    ALARM,
    COMMISSION,
    FAN_ALARM_TYPE,
    FAN_TYPE,
    SITE_FOLDER,
    STATUS,
    standard,
)
from fantwin.pipeline.outputs.opcua.events import OWN_FIELDS, condition_fields
from fantwin.pipeline.outputs.opcua.fan_values import VARIABLES
from fantwin.pipeline.outputs.opcua.requests import FAN_METHODS
from fantwin.pipeline.outputs.opcua.site_nodes import SiteNode, SiteNodes, ValueOf
from fantwin.pipeline.site.fleet import Fan

_NOTIFIES = [ua.EventNotifier.SubscribeToEvents, ua.EventNotifier.HistoryRead]
_FIRST_DECLARATION = 100
"""number of the first node below a type"""


@dataclass
class Watched:
    """A value of the site to which a client subscribes."""

    node: SiteNode
    attribute: int
    callback: Callable[..., Any]
    _sent: tuple[object, ...] = ()

    async def publish(self, handle: int) -> None:
        """Send the value, if it is another one than when it was sent last."""
        value = self.node.read(self.attribute)
        before, self._sent = self._sent, (value.Value, value.StatusCode, value.SourceTimestamp)
        if self._sent != before:
            await self.callback(handle, value)


class SiteAddressSpace(AddressSpace):
    """The address space of the library with the nodes of a site, of which there are too many to keep.

    Attributes:
        namespace: index of the server's own nodes.
        site: the nodes of trays and fans; None: not yet.
        watched: the values to which clients subscribe, by handle.
    """

    def __init__(self) -> None:
        super().__init__()
        self.namespace = 0
        self.site: SiteNodes | None = None
        self.watched: dict[int, Watched] = {}
        self._handles = count(1 << 30)  # the library counts from 201

    def _of_site(self, nodeid: ua.NodeId) -> SiteNode | None:
        return self.site.node(nodeid) if self.site else None

    def __contains__(self, nodeid: ua.NodeId) -> bool:
        return super().__contains__(nodeid) or self._of_site(nodeid) is not None

    def __getitem__(self, nodeid: ua.NodeId) -> Any:
        return self._of_site(nodeid) or super().__getitem__(nodeid)

    def get(self, nodeid: ua.NodeId) -> Any:
        """A node; None: there is none."""
        return self._of_site(nodeid) or super().get(nodeid)

    def read_attribute_value(self, nodeid: ua.NodeId, attr: ua.AttributeIds) -> ua.DataValue:
        """The value of an attribute."""
        node = self._of_site(nodeid)
        return node.read(attr) if node else super().read_attribute_value(nodeid, attr)

    def add_datachange_callback(
        self, nodeid: ua.NodeId, attr: ua.AttributeIds, callback: Callable[..., Any]
    ) -> tuple[ua.StatusCode, int]:
        """Subscribe to an attribute: whether it is there, and a handle."""
        node = self._of_site(nodeid)
        if node is None:
            return super().add_datachange_callback(nodeid, attr, callback)
        if node.read(attr).StatusCode == STATUS["BadAttributeIdInvalid"]:
            return STATUS["BadAttributeIdInvalid"], 0
        handle = next(self._handles)
        self.watched[handle] = Watched(node, attr, callback)
        return ua.StatusCode(), handle

    def delete_datachange_callback(self, handle: int) -> None:
        """End a subscription."""
        if self.watched.pop(handle, None) is None:
            super().delete_datachange_callback(handle)


async def build_address_space(
    server: Server, nodes: SiteAddressSpace, site: str, trays: Sequence[TrayConfig], value_of: ValueOf
) -> SiteNodes:
    """Add all that the server has of its own; returns the nodes of the site. nodes: those of the server."""
    namespace = nodes.namespace
    own = await _add_types(server, namespace)
    folder = await server.nodes.objects.add_folder(ua.NodeId(SITE_FOLDER, namespace), _name(site, namespace))
    await folder.set_event_notifier(_NOTIFIES)
    await server.nodes.server.set_event_notifier(_NOTIFIES)
    await server.nodes.server.add_reference(folder, ua.ObjectIds.HasNotifier)
    history = server.get_node(ua.NodeId(ua.ObjectIds.HistoryServerCapabilities_AccessHistoryEventsCapability))
    await history.write_value(True)

    nodes.site = SiteNodes(nodes, own, namespace, site, trays, value_of)
    nodes[folder.nodeid].references.extend(nodes.site.trays_in_folder())
    return nodes.site


async def _add_types(server: Server, namespace: int) -> dict[str, ua.NodeId]:
    """FanType, and FanAlarmType with the fields that the standard does not have; returns their declarations, by path
    below a fan."""
    alarm_type = await server.get_node(standard("AlarmConditionType")).add_object_type(
        ua.NodeId(FAN_ALARM_TYPE, namespace), _name("FanAlarmType", namespace)
    )
    fan_type = await server.nodes.base_object_type.add_object_type(
        ua.NodeId(FAN_TYPE, namespace), _name("FanType", namespace)
    )
    numbers = count(_FIRST_DECLARATION)
    declared: dict[str, Node] = {}
    fields = condition_fields(Fan("", 0), None, 0, namespace)
    for name in OWN_FIELDS:
        node = ua.NodeId(next(numbers), namespace)
        declared[f"{ALARM}/{name}"] = await alarm_type.add_property(node, _name(name, namespace), fields[name])
    for name, variable in VARIABLES.items():
        node = ua.NodeId(next(numbers), namespace)
        found = await fan_type.add_variable(node, _name(name, namespace), ua.Variant(variable.empty))
        declared[name] = found
        about = ua.Variant(ua.LocalizedText(variable.about))
        await found.write_attribute(ua.AttributeIds.Description, ua.DataValue(about))
    declared[ALARM] = await fan_type.add_object(ua.NodeId(next(numbers), namespace), _name(ALARM, namespace))
    for node in declared.values():
        await node.set_modelling_rule(True)
    (commission,) = FAN_METHODS
    await _add_method(fan_type, ua.NodeId(COMMISSION, namespace), _name(commission.name, namespace))
    await fan_type.add_reference(alarm_type, ua.ObjectIds.GeneratesEvent)
    return {path: node.nodeid for path, node in declared.items()}


async def _add_method(fan_type: Node, node: ua.NodeId, name: ua.QualifiedName) -> None:
    comment = ua.Argument(
        Name="Comment",
        DataType=standard("LocalizedText"),
        ValueRank=ua.Int32(-1),
        Description=ua.LocalizedText("why, for the record"),
    )

    async def unbound(_parent: ua.NodeId, *_arguments: ua.Variant) -> ua.StatusCode:
        return ua.StatusCode(ua.UInt32(ua.StatusCodes.BadNotImplemented))

    method = await fan_type.add_method(node, name, unbound, [comment], [])
    await method.set_modelling_rule(True)


def _name(name: str, namespace: int) -> ua.QualifiedName:
    return ua.QualifiedName(name, ua.UInt16(namespace))
