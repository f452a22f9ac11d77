"""What exists once in the address space: the types of fans and their alarms, and the folder of the site."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

from collections.abc import Sequence

from asyncua import Node, Server, ua

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.outputs.opcua.conditions import OWN_FIELDS
from fantwin.pipeline.outputs.opcua.fan_values import VARIABLES
from fantwin.pipeline.outputs.opcua.identifiers import COMMISSION, FAN_ALARM_TYPE, FAN_TYPE, SITE_FOLDER
from fantwin.pipeline.outputs.opcua.requests import FAN_METHODS
from fantwin.pipeline.outputs.opcua.site_nodes import SiteNodes, ValueOf
from fantwin.pipeline.outputs.opcua.templates import standard

_NOTIFIES = [ua.EventNotifier.SubscribeToEvents, ua.EventNotifier.HistoryRead]
_FIRST_DECLARATION = 100
"""number of the first node below a type"""


async def build_address_space(
    server: Server, namespace: int, site: str, trays: Sequence[TrayConfig], value_of: ValueOf
) -> SiteNodes:
    """Add all that the server has of its own; returns the nodes of the site. namespace: index of its own nodes."""
    await _add_types(server, namespace)
    folder = await server.nodes.objects.add_folder(ua.NodeId(SITE_FOLDER, namespace), _name(site, namespace))
    await folder.set_event_notifier(_NOTIFIES)
    await server.nodes.server.set_event_notifier(_NOTIFIES)
    await server.nodes.server.add_reference(folder, ua.ObjectIds.HasNotifier)
    history = server.get_node(ua.NodeId(ua.ObjectIds.HistoryServerCapabilities_AccessHistoryEventsCapability))
    await history.write_value(True)
    nodes = SiteNodes(server.iserver.aspace._nodes, namespace, site, trays, value_of)
    server.iserver.aspace._nodes = nodes  # type: ignore[assignment]  as the library does it for nodes in a file
    nodes[folder.nodeid].references.extend(nodes.trays_in_folder())
    return nodes


async def _add_types(server: Server, namespace: int) -> None:
    """FanType, and FanAlarmType with the fields that the standard does not have."""
    alarm_type = await server.get_node(standard("AlarmConditionType")).add_object_type(
        ua.NodeId(FAN_ALARM_TYPE, namespace), _name("FanAlarmType", namespace)
    )
    number = _FIRST_DECLARATION
    for name, kind in OWN_FIELDS.items():
        value = ua.Variant("" if kind == "String" else 0.0, ua.VariantType[kind])
        declared = await alarm_type.add_property(ua.NodeId(number, namespace), _name(name, namespace), value)
        await declared.set_modelling_rule(True)
        number += 1
    fan_type = await server.nodes.base_object_type.add_object_type(
        ua.NodeId(FAN_TYPE, namespace), _name("FanType", namespace)
    )
    for variable in VARIABLES:
        empty = {"String": "", "Boolean": False}.get(variable.type, 0.0)
        value = ua.Variant(empty, ua.VariantType[variable.type])
        declared = await fan_type.add_variable(ua.NodeId(number, namespace), _name(variable.name, namespace), value)
        await declared.set_modelling_rule(True)
        number += 1
    (commission,) = FAN_METHODS
    await _add_method(fan_type, ua.NodeId(COMMISSION, namespace), _name(commission.name, namespace))
    await fan_type.add_reference(alarm_type, ua.ObjectIds.GeneratesEvent)


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
