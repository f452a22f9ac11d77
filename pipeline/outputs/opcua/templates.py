"""What every fan looks like in the address space: its nodes, from which those of a certain fan are made when somebody
asks for them. Five thousand fans have 300,000 nodes, which nobody keeps."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from asyncua import ua

from fantwin.pipeline.outputs.opcua.encoding import (
    ALARM,
    COMMISSION,
    FAN_ALARM_TYPE,
    FAN_TYPE,
    SHELVING_STATE,
    standard,
)
from fantwin.pipeline.outputs.opcua.events import OWN_FIELDS, condition_fields
from fantwin.pipeline.outputs.opcua.fan_values import VARIABLES, FanVariable
from fantwin.pipeline.outputs.opcua.requests import METHODS, SHELVING_METHODS, ConditionMethod
from fantwin.pipeline.site.fleet import Fan

OBJECT_NOTIFIES = ua.Byte(5)
"""SubscribeToEvents and HistoryRead"""
UNIT_RPM = ua.EUInformation(
    NamespaceUri="http://www.opcfoundation.org/UA/units/un/cefact",
    UnitId=ua.Int32(5394509),  # "RPM" of UN/CEFACT
    DisplayName=ua.LocalizedText("r/min"),
    Description=ua.LocalizedText("revolutions per minute"),
)
_DURATIONS = {"ShelvingState/UnshelveTime", "MaxTimeShelved"}
_CONDITION_VARIABLES = {"Quality", "LastSeverity", "Comment"}
_METHOD_TYPES = (
    "ShelvedStateMachineType",
    "AlarmConditionType",
    "AcknowledgeableConditionType",
    "ConditionType",
    "AlarmConditionType_ShelvingState",
)


@dataclass(frozen=True, eq=False)
class Template:
    """A node below a fan.

    Attributes:
        path: below the fan; empty: the fan itself.
        type: its type definition.
        by: the reference from its parent.
        attributes: all but NodeId, Value, and the names of a fan.
        children: paths.
        methods: identifiers of methods that it shares with its type.
    """

    path: str
    browse_name: ua.QualifiedName
    node_class: ua.NodeClass
    type: ua.NodeId
    by: ua.NodeId
    attributes: Mapping[int, ua.DataValue]
    children: list[str] = field(default_factory=list)
    methods: Sequence[ua.NodeId] = ()


def method_nodes(method: ConditionMethod) -> list[ua.NodeId]:
    """The nodes of a method in the types of the standard."""
    ids = [getattr(ua.ObjectIds, f"{owner}_{method.name}", None) for owner in _METHOD_TYPES]
    return [ua.NodeId(found) for found in ids if found is not None]


def templates(namespace: int) -> dict[str, Template]:
    """All nodes of a fan, by path."""
    made: dict[str, Template] = {}

    def add(template: Template) -> None:
        made[template.path] = template
        if template.path:
            made[template.path.rpartition("/")[0]].children.append(template.path)

    fan_type, alarm_type = ua.NodeId(FAN_TYPE, namespace), ua.NodeId(FAN_ALARM_TYPE, namespace)
    commission = [ua.NodeId(COMMISSION, namespace)]
    add(_object("", "", namespace, fan_type, "Organizes", commission, OBJECT_NOTIFIES))
    for variable in VARIABLES:
        add(_fan_variable(variable, namespace))
        if variable.unit:
            add(_property(f"{variable.name}/EURange", "Range"))
            add(_property(f"{variable.name}/EngineeringUnits", "EUInformation"))
    methods = [node for method in METHODS for node in method_nodes(method)]
    add(_object(ALARM, ALARM, namespace, alarm_type, "HasComponent", methods, ua.Byte(0)))
    shelving = [node for method in SHELVING_METHODS for node in method_nodes(method)[:1]]
    machine = standard("ShelvedStateMachineType")
    add(_object(SHELVING_STATE, "ShelvingState", 0, machine, "HasComponent", shelving, ua.Byte(0)))
    fields = condition_fields(Fan("", 0), None, 0, namespace)
    for path, value in fields.items():
        add(_condition_field(path, value.VariantType, f"{path}/Id" in fields, namespace))
    return made


def _attributes(browse_name: ua.QualifiedName, node_class: ua.NodeClass, **more: Any) -> dict[Any, ua.DataValue]:
    values = {
        "BrowseName": ua.Variant(browse_name),
        "DisplayName": ua.Variant(ua.LocalizedText(browse_name.Name)),
        "Description": ua.Variant(ua.LocalizedText("")),
        "NodeClass": ua.Variant(node_class, ua.VariantType.Int32),
        "WriteMask": ua.Variant(0, ua.VariantType.UInt32),
        "UserWriteMask": ua.Variant(0, ua.VariantType.UInt32),
        **more,
    }
    return {ua.AttributeIds[name]: ua.DataValue(value) for name, value in values.items()}


def _object(
    path: str,
    name: str,
    namespace: int,
    kind: ua.NodeId,
    by: str,
    methods: Sequence[ua.NodeId],
    notifies: ua.Byte,
) -> Template:
    browse_name = ua.QualifiedName(name, ua.UInt16(namespace))
    attributes = _attributes(browse_name, ua.NodeClass.Object, EventNotifier=ua.Variant(notifies, ua.VariantType.Byte))
    return Template(path, browse_name, ua.NodeClass.Object, kind, standard(by), attributes, methods=methods)


def _variable(path: str, namespace: int, data_type: str, type_of: str, by: str, about: str = "") -> Template:
    browse_name = ua.QualifiedName(path.rpartition("/")[2], ua.UInt16(namespace))
    attributes = _attributes(
        browse_name,
        ua.NodeClass.Variable,
        Description=ua.Variant(ua.LocalizedText(about)),
        DataType=ua.Variant(standard(data_type), ua.VariantType.NodeId),
        ValueRank=ua.Variant(-1, ua.VariantType.Int32),
        AccessLevel=ua.Variant(1, ua.VariantType.Byte),
        UserAccessLevel=ua.Variant(1, ua.VariantType.Byte),
        MinimumSamplingInterval=ua.Variant(1000.0, ua.VariantType.Double),
        Historizing=ua.Variant(False, ua.VariantType.Boolean),
    )
    return Template(path, browse_name, ua.NodeClass.Variable, standard(type_of), standard(by), attributes)


def _fan_variable(variable: FanVariable, namespace: int) -> Template:
    type_of = "AnalogItemType" if variable.unit else "BaseDataVariableType"
    return _variable(variable.name, namespace, variable.type, type_of, "HasComponent", variable.about)


def _property(path: str, data_type: str, namespace: int = 0) -> Template:
    return _variable(path, namespace, data_type, "PropertyType", "HasProperty")


def _condition_field(path: str, kind: ua.VariantType, has_id: bool, namespace: int) -> Template:
    """The template of a field. kind: its built-in type; null for a time that is not set."""
    data_type = "Duration" if path in _DURATIONS else kind.name
    if kind in (ua.VariantType.Null, ua.VariantType.DateTime):
        data_type = "UtcTime"
    below = f"{ALARM}/{path}"
    if path == "ShelvingState/CurrentState":
        return _variable(below, 0, data_type, "FiniteStateVariableType", "HasComponent")
    if has_id:
        return _variable(below, 0, data_type, "TwoStateVariableType", "HasComponent")
    if path in _CONDITION_VARIABLES:
        return _variable(below, 0, data_type, "ConditionVariableType", "HasComponent")
    return _property(below, data_type, namespace if path in OWN_FIELDS else 0)
