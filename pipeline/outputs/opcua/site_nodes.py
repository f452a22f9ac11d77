"""The nodes of the site, which are made when somebody asks for them."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

from collections.abc import Callable, Sequence

from asyncua import ua

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.opcua.encoding import SITE_FOLDER, STATUS, SharedValue, fan_of, standard
from fantwin.pipeline.outputs.opcua.templates import Template, templates
from fantwin.pipeline.site.fleet import Fan

ValueOf = Callable[[Fan, str], SharedValue]
"""the value of a node, from its fan and its path below the fan"""


class SiteNode:
    """A node of the site, as the library uses it, with attributes and references that are made when asked for."""

    call = None

    def __init__(
        self,
        nodeid: ua.NodeId,
        browse_name: Callable[[], ua.QualifiedName],
        template: Template,
        references: Callable[[], list[ua.ReferenceDescription]],
        value: Callable[[], SharedValue] | None = None,
    ) -> None:
        """template: has the other attributes. value: of a variable; None: it has none."""
        self.nodeid = nodeid
        self._browse_name, self._template, self._references, self._value = browse_name, template, references, value

    @property
    def references(self) -> list[ua.ReferenceDescription]:
        """Both ways."""
        return self._references()

    def read(self, attribute: int) -> ua.DataValue:
        """The value of an attribute, with a bad status if the node has no such attribute."""
        if attribute == ua.AttributeIds.Value and self._value is not None:
            return self._value()
        if attribute == ua.AttributeIds.NodeId:
            return ua.DataValue(ua.Variant(self.nodeid, ua.VariantType.NodeId))
        if attribute == ua.AttributeIds.BrowseName:
            return ua.DataValue(ua.Variant(self._browse_name()))
        if attribute == ua.AttributeIds.DisplayName:
            return ua.DataValue(ua.Variant(ua.LocalizedText(self._browse_name().Name)))
        return self._template.attributes.get(attribute) or ua.DataValue(StatusCode=STATUS["BadAttributeIdInvalid"])


class SiteNodes:
    """The nodes of trays and fans, made anew when somebody asks for one."""

    def __init__(
        self,
        name_of: Callable[[ua.NodeId], ua.QualifiedName],
        namespace: int,
        site: str,
        trays: Sequence[TrayConfig],
        value_of: ValueOf,
    ) -> None:
        """name_of: the browse name of a node of the standard, or of a type."""
        self._name_of = name_of
        self._site = site
        self._namespace = namespace
        self._trays = {tray.name: tray for tray in trays}
        self._value_of = value_of
        self._templates = templates(namespace)

    def node(self, nodeid: ua.NodeId) -> SiteNode | None:
        """One of them; None: it is not one."""
        name = nodeid.Identifier if nodeid.NamespaceIndex == self._namespace else None
        if isinstance(name, str) and name in self._trays:
            return SiteNode(nodeid, lambda: self._own_name(name), self._templates[""], lambda: self._of_tray(name))
        found = self.fan(nodeid)
        if found is None:
            return None
        fan, path = found
        template = self._templates[path]
        is_variable = template.node_class == ua.NodeClass.Variable
        value = (lambda: self._value_of(fan, path)) if is_variable else None
        return SiteNode(nodeid, lambda: self._name(fan, template), template, lambda: self._of_fan(fan, template), value)

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
        return [self._to_folder(name, name, is_forward=True) for name in self._trays]

    def _own_name(self, name: str) -> ua.QualifiedName:
        return ua.QualifiedName(name, ua.UInt16(self._namespace))

    def _name(self, fan: Fan, template: Template) -> ua.QualifiedName:
        """The browse name of a node of a fan."""
        return template.browse_name if template.path else self._own_name(f"Fan{fan.number}")

    def _of_tray(self, name: str) -> list[ua.ReferenceDescription]:
        fans = [self._to(Fan(name, number), "", standard("Organizes")) for number in range(self._trays[name].fans)]
        parent = self._to_folder(SITE_FOLDER, self._site)
        return [_type_reference(standard("FolderType"), "FolderType", 0), parent, *fans]

    def _to_folder(self, identifier: str | int, name: str, *, is_forward: bool = False) -> ua.ReferenceDescription:
        target, folder = ua.NodeId(identifier, self._namespace), standard("FolderType")
        return _reference(
            standard("Organizes"), target, self._own_name(name), ua.NodeClass.Object, folder, is_forward=is_forward
        )

    def _of_fan(self, fan: Fan, template: Template) -> list[ua.ReferenceDescription]:
        name = self._name_of(template.type)
        found = [_type_reference(template.type, name.Name, name.NamespaceIndex)]
        if template.path:
            found.append(self._to(fan, template.path.rpartition("/")[0], template.by, is_forward=False))
        else:
            found.append(self._to_folder(fan.tray, fan.tray))
        found += [self._to(fan, path, self._templates[path].by) for path in template.children]
        if not template.path:
            found.append(self._to(fan, "Alarm", standard("HasCondition")))
        return found + [self._to_method(node) for node in template.methods]

    def _to(self, fan: Fan, path: str, by: ua.NodeId, *, is_forward: bool = True) -> ua.ReferenceDescription:
        template = self._templates[path]
        target = ua.NodeId(f"{fan}/{path}" if path else str(fan), self._namespace)
        return _reference(
            by, target, self._name(fan, template), template.node_class, template.type, is_forward=is_forward
        )

    def _to_method(self, node: ua.NodeId) -> ua.ReferenceDescription:
        return _reference(standard("HasComponent"), node, self._name_of(node), ua.NodeClass.Method, ua.NodeId())


def _reference(
    by: ua.NodeId,
    target: ua.NodeId,
    browse_name: ua.QualifiedName,
    node_class: ua.NodeClass,
    type_of: ua.NodeId,
    *,
    is_forward: bool = True,
) -> ua.ReferenceDescription:
    found = ua.ReferenceDescription()
    found.ReferenceTypeId, found.NodeId, found.IsForward = by, target, is_forward  # type: ignore[assignment]
    found.BrowseName, found.DisplayName = browse_name, ua.LocalizedText(browse_name.Name)
    found.NodeClass, found.TypeDefinition = node_class, type_of  # type: ignore[assignment]
    return found


def _type_reference(type_of: ua.NodeId, name: str, namespace: int) -> ua.ReferenceDescription:
    node_class = ua.NodeClass.VariableType if name.endswith(("VariableType", "ItemType", "PropertyType")) else None
    browse_name = ua.QualifiedName(name, ua.UInt16(namespace))
    return _reference(
        standard("HasTypeDefinition"), type_of, browse_name, node_class or ua.NodeClass.ObjectType, ua.NodeId()
    )
