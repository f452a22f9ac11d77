"""The nodes of the site, made when somebody asks for them: five thousand fans have 300,000, which nobody keeps.

Each node below a fan has the attributes of its declaration, a node of the standard's types or of `FanType`.
"""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from asyncua import ua
from asyncua.server.address_space import AddressSpace

from fantwin.pipeline.config.settings import FanConfig, TrayConfig
from fantwin.pipeline.outputs.opcua.encoding import (
    ALARM,
    COMMISSION,
    FAN_ALARM_TYPE,
    FAN_TYPE,
    SHELVING_STATE,
    SITE_FOLDER,
    SharedValue,
    fan_of,
    standard,
)
from fantwin.pipeline.outputs.opcua.events import OWN_FIELDS, condition_fields
from fantwin.pipeline.outputs.opcua.fan_values import VARIABLES
from fantwin.pipeline.outputs.opcua.requests import METHODS, SHELVING_METHODS, ConditionMethod
from fantwin.pipeline.site.fleet import Fan

ValueOf = Callable[[Fan, str], SharedValue]
"""the value of a node, from its fan and its path below the fan"""
SAMPLING_MS = 1000.0
NAMELESS = FanConfig()
ANALOG_PROPERTIES = {"EURange": "AnalogItemType_EURange", "EngineeringUnits": "BaseAnalogType_EngineeringUnits"}
_CONDITION_TYPES = ("AlarmConditionType", "AcknowledgeableConditionType", "ConditionType", "BaseEventType")
_METHOD_TYPES = ("ShelvedStateMachineType", *_CONDITION_TYPES, "AlarmConditionType_ShelvingState")


@dataclass(frozen=True, eq=False)
class Template:
    """A node below a fan.

    Attributes:
        path: below the fan; empty: the fan itself.
        declaration: the node that has its attributes.
        type: its type definition.
        by: the reference from its parent.
        children: paths.
        methods: identifiers of methods that it shares with its type.
    """

    path: str
    declaration: ua.NodeId
    name: ua.QualifiedName
    node_class: ua.NodeClass
    type: ua.NodeId
    by: ua.NodeId
    methods: Sequence[ua.NodeId] = ()
    children: list[str] = field(default_factory=list[str])


def method_nodes(method: ConditionMethod) -> list[ua.NodeId]:
    """The nodes of a method in the types of the standard."""
    ids = [getattr(ua.ObjectIds, f"{owner}_{method.name}", None) for owner in _METHOD_TYPES]
    return [ua.NodeId(found) for found in ids if found is not None]


def _declarations(own: dict[str, ua.NodeId], namespace: int) -> dict[str, ua.NodeId]:
    """The declaration of each node below a fan, by path, parents first. own: those of `FanType` and `FanAlarmType`."""
    found: dict[str, ua.NodeId] = {}
    for name, variable in VARIABLES.items():
        found[name] = own[name]
        if variable.is_speed:
            found |= {f"{name}/{each}": standard(declared) for each, declared in ANALOG_PROPERTIES.items()}
    found[ALARM] = own[ALARM]
    found[SHELVING_STATE] = standard("AlarmConditionType_ShelvingState")
    for path in condition_fields(Fan("", 0), None, 0, namespace):
        names = (f"{owner}_{path.replace('/', '_')}" for owner in _CONDITION_TYPES)
        of_standard = (name for name in names if hasattr(ua.ObjectIds, name))
        found[f"{ALARM}/{path}"] = own[f"{ALARM}/{path}"] if path in OWN_FIELDS else standard(next(of_standard))
    return found


class SiteNode:
    """A node of the site, as the library uses it, with references that are made when asked for."""

    call = None

    def __init__(
        self,
        nodeid: ua.NodeId,
        name: ua.QualifiedName,
        attribute_of: Callable[[int], ua.DataValue],
        references: Callable[[], list[ua.ReferenceDescription]],
        value: Callable[[], SharedValue] | None = None,
        about: FanConfig = NAMELESS,
    ) -> None:
        """attribute_of: the attributes that its declaration has. value: of a variable; None: it has none. about: of the
        node of a fan, its name and place."""
        self.nodeid = nodeid
        self._attribute_of, self._references, self._value = attribute_of, references, value
        self._own = {
            ua.AttributeIds.NodeId: ua.Variant(nodeid, ua.VariantType.NodeId),
            ua.AttributeIds.BrowseName: ua.Variant(name),
            ua.AttributeIds.DisplayName: ua.Variant(ua.LocalizedText(about.name or name.Name)),
        }
        if value is None:
            self._own[ua.AttributeIds.Description] = ua.Variant(ua.LocalizedText(about.place))
        else:
            self._own[ua.AttributeIds.MinimumSamplingInterval] = ua.Variant(SAMPLING_MS, ua.VariantType.Double)

    @property
    def references(self) -> list[ua.ReferenceDescription]:
        """Both ways."""
        return self._references()

    def read(self, attribute: int) -> ua.DataValue:
        """The value of an attribute, with a bad status if the node has no such attribute."""
        if attribute == ua.AttributeIds.Value and self._value is not None:
            return self._value()
        if attribute in self._own:
            return ua.DataValue(self._own[attribute])
        return self._attribute_of(attribute)


class SiteNodes:
    """The nodes of trays and fans, made anew when somebody asks for one."""

    def __init__(
        self,
        space: AddressSpace,
        own: dict[str, ua.NodeId],
        namespace: int,
        site: str,
        trays: Sequence[TrayConfig],
        value_of: ValueOf,
    ) -> None:
        """space: has the types. own: the declarations of this server's own types, by path below a fan."""
        self._space, self._namespace, self._site = space, namespace, site
        self._trays = {tray.name: tray for tray in trays}
        self._value_of = value_of
        self._folder = ua.NodeId(SITE_FOLDER, namespace)
        of_types = {
            "": ua.NodeId(FAN_TYPE, namespace),
            ALARM: ua.NodeId(FAN_ALARM_TYPE, namespace),
            **{name: standard("AnalogItemType") for name, variable in VARIABLES.items() if variable.is_speed},
        }
        methods = {
            "": [ua.NodeId(COMMISSION, namespace)],
            ALARM: [node for method in METHODS for node in method_nodes(method)],
            SHELVING_STATE: [node for method in SHELVING_METHODS for node in method_nodes(method)[:1]],
        }
        self._templates: dict[str, Template] = {}
        for path, declaration in {"": self._folder, **_declarations(own, namespace)}.items():
            by, found_type = self._placed(declaration)
            self._templates[path] = Template(
                path,
                declaration,
                self._attribute(declaration, ua.AttributeIds.BrowseName),
                ua.NodeClass(self._attribute(declaration, ua.AttributeIds.NodeClass)),
                of_types.get(path, found_type),
                by,
                methods.get(path, ()),
            )
            if path:
                self._templates[path.rpartition("/")[0]].children.append(path)

    def node(self, nodeid: ua.NodeId) -> SiteNode | None:
        """One of them; None: it is not one."""
        tray = nodeid.Identifier if nodeid.NamespaceIndex == self._namespace else None
        if isinstance(tray, str) and tray in self._trays:
            return SiteNode(nodeid, self._own_name(tray), self._attributes_of(""), lambda: self._of_tray(tray))
        found = self.fan(nodeid)
        if found is None:
            return None
        fan, path = found
        template = self._templates[path]
        value = (lambda: self._value_of(fan, path)) if template.node_class == ua.NodeClass.Variable else None
        name = self._name(fan, template)
        about = self._about(fan, path)
        return SiteNode(nodeid, name, self._attributes_of(path), lambda: self._of_fan(fan, template), value, about)

    def fan(self, nodeid: ua.NodeId) -> tuple[Fan, str] | None:
        """The fan to which a node belongs, and the path below it; None: it belongs to none."""
        found = fan_of(nodeid.Identifier) if nodeid.NamespaceIndex == self._namespace else None
        if found is None:
            return None
        fan, path = found
        tray = self._trays.get(fan.tray)
        return found if tray is not None and fan.number < tray.fans and path in self._templates else None

    def trays_in_folder(self) -> list[ua.ReferenceDescription]:
        """The references of the site's folder to its trays."""
        return [self._to_folder(name, name) for name in self._trays]

    def _placed(self, declaration: ua.NodeId) -> tuple[ua.NodeId, ua.NodeId]:
        """The reference from the parent of a declaration, and its type definition."""
        above = [each.ReferenceTypeId for each in self._space[declaration].references if not each.IsForward]
        types = [
            each.NodeId
            for each in self._space[declaration].references
            if each.IsForward and each.ReferenceTypeId == standard("HasTypeDefinition")
        ]
        return above[0], types[0]

    def _attribute(self, node: ua.NodeId, attribute: ua.AttributeIds) -> Any:
        found = self._space.read_attribute_value(node, attribute).Value
        return found.Value if found is not None else None

    def _attributes_of(self, path: str) -> Callable[[int], ua.DataValue]:
        declaration = self._templates[path].declaration
        return lambda attribute: self._space.read_attribute_value(declaration, attribute)

    def _own_name(self, name: str) -> ua.QualifiedName:
        return ua.QualifiedName(name, ua.UInt16(self._namespace))

    def _name(self, fan: Fan, template: Template) -> ua.QualifiedName:
        """The browse name of a node of a fan."""
        return template.name if template.path else self._own_name(f"Fan{fan.number}")

    def _about(self, fan: Fan, path: str) -> FanConfig:
        """Name and place of a fan, for its own node."""
        return NAMELESS if path else self._trays[fan.tray].fan[fan.number]

    def _of_tray(self, name: str) -> list[ua.ReferenceDescription]:
        fans = [self._to(Fan(name, number), "", standard("Organizes")) for number in range(self._trays[name].fans)]
        parent = self._to_folder(SITE_FOLDER, self._site, is_forward=False)
        return [self._to_shared("HasTypeDefinition", standard("FolderType")), parent, *fans]

    def _of_fan(self, fan: Fan, template: Template) -> list[ua.ReferenceDescription]:
        found = [self._to_shared("HasTypeDefinition", template.type)]
        if template.path:
            found.append(self._to(fan, template.path.rpartition("/")[0], template.by, is_forward=False))
        else:
            found.append(self._to_folder(fan.tray, fan.tray, is_forward=False))
            found.append(self._to(fan, ALARM, standard("HasCondition")))
        found += [self._to(fan, path, self._templates[path].by) for path in template.children]
        return found + [self._to_shared("HasComponent", node) for node in template.methods]

    def _to(self, fan: Fan, path: str, by: ua.NodeId, *, is_forward: bool = True) -> ua.ReferenceDescription:
        template = self._templates[path]
        target = ua.NodeId(f"{fan}/{path}" if path else str(fan), self._namespace)
        name = self._name(fan, template)
        shown = self._about(fan, path).name
        return _reference(by, target, name, template.node_class, template.type, is_forward=is_forward, shown=shown)

    def _to_folder(self, identifier: str | int, name: str, *, is_forward: bool = True) -> ua.ReferenceDescription:
        by, target = standard("Organizes"), ua.NodeId(identifier, self._namespace)
        kind = standard("FolderType")
        return _reference(by, target, self._own_name(name), ua.NodeClass.Object, kind, is_forward=is_forward)

    def _to_shared(self, by: str, node: ua.NodeId) -> ua.ReferenceDescription:
        """The reference to a type or to a method of a type."""
        name, kind = (self._attribute(node, each) for each in (ua.AttributeIds.BrowseName, ua.AttributeIds.NodeClass))
        return _reference(standard(by), node, name, ua.NodeClass(kind), ua.NodeId(), is_forward=True)


def _reference(
    by: ua.NodeId,
    target: ua.NodeId,
    name: ua.QualifiedName,
    node_class: ua.NodeClass,
    type_of: ua.NodeId,
    *,
    is_forward: bool,
    shown: str = "",
) -> ua.ReferenceDescription:
    """A reference. shown: what people see; empty: the name."""
    text = ua.LocalizedText(shown or name.Name)
    return ua.ReferenceDescription(by, is_forward, target, name, text, node_class, type_of)
