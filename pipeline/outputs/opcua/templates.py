"""What every fan looks like in the address space: its nodes, from which those of a certain fan are made when somebody
asks for them. Five thousand fans have 300,000 nodes, which nobody keeps."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from asyncua import ua

from fantwin.pipeline.outputs.opcua.conditions import ALL_FIELDS, OWN_FIELDS
from fantwin.pipeline.outputs.opcua.fan_values import VARIABLES, FanVariable
from fantwin.pipeline.outputs.opcua.identifiers import ALARM, COMMISSION, FAN_ALARM_TYPE, FAN_TYPE, SHELVING_STATE
from fantwin.pipeline.outputs.opcua.requests import METHODS, SHELVING_METHODS, ConditionMethod

OBJECT_NOTIFIES = ua.Byte(5)
"""SubscribeToEvents and HistoryRead"""
UNIT_RPM = ua.EUInformation(
    NamespaceUri="http://www.opcfoundation.org/UA/units/un/cefact",
    UnitId=ua.Int32(5394509),  # "RPM" of UN/CEFACT
    DisplayName=ua.LocalizedText("r/min"),
    Description=ua.LocalizedText("revolutions per minute"),
)
_DURATIONS = {"ShelvingState/UnshelveTime", "MaxTimeShelved"}
_TWO_STATES = {
    "EnabledState",
    "AckedState",
    "ConfirmedState",
    "ActiveState",
    "SuppressedState",
    "OutOfServiceState",
    "LatchedState",
}
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
        kind: built-in type of a variable; empty: it is an object.
        children: paths.
        methods: identifiers of methods that it shares with its type.
    """

    path: str
    browse_name: ua.QualifiedName
    node_class: ua.NodeClass
    type: ua.NodeId
    by: ua.NodeId
    attributes: Mapping[int, ua.DataValue]
    kind: str = ""
    children: list[str] = field(default_factory=list)
    methods: Sequence[ua.NodeId] = ()


def standard(name: str) -> ua.NodeId:
    """A node of the standard."""
    return ua.NodeId(getattr(ua.ObjectIds, name))


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
            add(_property(f"{variable.name}/EURange", "ExtensionObject", standard("Range")))
            add(_property(f"{variable.name}/EngineeringUnits", "ExtensionObject", standard("EUInformation")))
    methods = [node for method in METHODS for node in method_nodes(method)]
    add(_object(ALARM, ALARM, namespace, alarm_type, "HasComponent", methods, ua.Byte(0)))
    shelving = [node for method in SHELVING_METHODS for node in method_nodes(method)[:1]]
    machine = standard("ShelvedStateMachineType")
    add(_object(SHELVING_STATE, "ShelvingState", 0, machine, "HasComponent", shelving, ua.Byte(0)))
    for path, kind in ALL_FIELDS.items():
        add(_condition_field(path, kind, namespace))
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


def _variable(
    path: str, namespace: int, kind: str, data_type: ua.NodeId, type_of: str, by: str, about: str = ""
) -> Template:
    browse_name = ua.QualifiedName(path.rpartition("/")[2], ua.UInt16(namespace))
    attributes = _attributes(
        browse_name,
        ua.NodeClass.Variable,
        Description=ua.Variant(ua.LocalizedText(about)),
        DataType=ua.Variant(data_type, ua.VariantType.NodeId),
        ValueRank=ua.Variant(-1, ua.VariantType.Int32),
        AccessLevel=ua.Variant(1, ua.VariantType.Byte),
        UserAccessLevel=ua.Variant(1, ua.VariantType.Byte),
        MinimumSamplingInterval=ua.Variant(1000.0, ua.VariantType.Double),
        Historizing=ua.Variant(False, ua.VariantType.Boolean),
    )
    return Template(path, browse_name, ua.NodeClass.Variable, standard(type_of), standard(by), attributes, kind)


def _fan_variable(variable: FanVariable, namespace: int) -> Template:
    type_of = "AnalogItemType" if variable.unit else "BaseDataVariableType"
    data_type = standard(variable.type)
    return _variable(variable.name, namespace, variable.type, data_type, type_of, "HasComponent", variable.about)


def _property(path: str, kind: str, data_type: ua.NodeId, namespace: int = 0) -> Template:
    return _variable(path, namespace, kind, data_type, "PropertyType", "HasProperty")


def _condition_field(path: str, kind: str, namespace: int) -> Template:
    data_type = standard("Duration" if path in _DURATIONS else "UtcTime" if kind == "DateTime" else kind)
    below = f"{ALARM}/{path}"
    if path in _TWO_STATES:
        return _variable(below, 0, kind, data_type, "TwoStateVariableType", "HasComponent")
    if path in _CONDITION_VARIABLES:
        return _variable(below, 0, kind, data_type, "ConditionVariableType", "HasComponent")
    if path == "ShelvingState/CurrentState":
        return _variable(below, 0, kind, data_type, "FiniteStateVariableType", "HasComponent")
    return _property(below, kind, data_type, namespace if path in OWN_FIELDS else 0)
