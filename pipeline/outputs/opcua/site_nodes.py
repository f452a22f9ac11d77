"""The nodes of the site: made when somebody asks for them, and kept only while somebody subscribes to them."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from functools import cached_property
from typing import Any

from asyncua import ua
from asyncua.server.address_space import AttributeValue, NodeData

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.outputs.opcua.encoding import SharedValue
from fantwin.pipeline.outputs.opcua.identifiers import SITE_FOLDER, fan_of
from fantwin.pipeline.outputs.opcua.templates import Template, standard, templates
from fantwin.pipeline.site.fleet import Fan

_KEPT = 512
"""nodes that were asked for last"""
ValueOf = Callable[[Fan, str, str], SharedValue]
"""the value of a node: of which fan, its path below the fan, its built-in type"""


class SiteNode(NodeData):
    """A node of the site, with attributes and references that are made when they are asked for."""

    def __init__(
        self,
        nodeid: ua.NodeId,
        attributes: Mapping[ua.AttributeIds, ua.DataValue],
        references: Callable[[], list[ua.ReferenceDescription]],
        value: Callable[[], SharedValue] | None,
        watched: Callable[[SiteNode], None],
    ) -> None:
        """value: of a variable; None: it has none. watched: called when somebody subscribes, or ends it."""
        self.nodeid = nodeid
        self.attributes: Any = _Attributes(self, attributes, value, watched)
        self.call = None
        self.value = value
        self._sent: tuple[object, ...] = ()
        self._references = references

    def is_news(self, value: SharedValue) -> bool:
        """Whether a value is another one than when this was asked last."""
        before = self._sent
        self._sent = (value.Value, value.StatusCode, value.SourceTimestamp)
        return self._sent != before

    @cached_property
    def references(self) -> list[ua.ReferenceDescription]:  # type: ignore[override]
        """Both ways."""
        return self._references()


class _Attributes(MutableMapping[ua.AttributeIds, AttributeValue]):
    def __init__(
        self,
        node: SiteNode,
        static: Mapping[ua.AttributeIds, ua.DataValue],
        value: Callable[[], SharedValue] | None,
        watched: Callable[[SiteNode], None],
    ) -> None:
        self._node, self._static, self._value, self._watched = node, static, value, watched
        self._made: dict[ua.AttributeIds, AttributeValue] = {}

    def __contains__(self, attribute: object) -> bool:
        return attribute in self._static or (attribute == ua.AttributeIds.Value and self._value is not None)

    def __getitem__(self, attribute: ua.AttributeIds) -> AttributeValue:
        if attribute not in self._made:
            if attribute not in self:
                raise KeyError(attribute)
            self._made[attribute] = self._make(attribute)
        return self._made[attribute]

    def __setitem__(self, attribute: ua.AttributeIds, value: AttributeValue) -> None:
        raise TypeError("nodes of the site are not written")

    def __delitem__(self, attribute: ua.AttributeIds) -> None:
        raise TypeError("nodes of the site are not written")

    def __iter__(self) -> Iterator[ua.AttributeIds]:
        yield from self._static
        if self._value is not None:
            yield ua.AttributeIds.Value

    def __len__(self) -> int:
        return len(self._static) + (self._value is not None)

    @property
    def is_watched(self) -> bool:
        """Whether somebody subscribes to one of them."""
        return any(made.datachange_callbacks for made in self._made.values())

    def _make(self, attribute: ua.AttributeIds) -> AttributeValue:
        if attribute == ua.AttributeIds.Value and self._value is not None:
            value = self._value
            made = AttributeValue(ua.DataValue())
            made.value, made.value_callback = None, lambda _node, _attribute: value()
        else:
            made = AttributeValue(self._static[attribute])
        made.datachange_callbacks = _Callbacks(self._node, self._watched)
        return made


class _Callbacks(dict[int, Callable[..., Any]]):
    """Of those who subscribe to an attribute."""

    def __init__(self, node: SiteNode, watched: Callable[[SiteNode], None]) -> None:
        super().__init__()
        self._node, self._watched = node, watched

    def __setitem__(self, handle: int, callback: Callable[..., Any]) -> None:
        super().__setitem__(handle, callback)
        self._watched(self._node)

    def pop(self, handle: int, *default: Any) -> Any:
        found = super().pop(handle, *default)
        self._watched(self._node)
        return found


class SiteNodes(MutableMapping[ua.NodeId, NodeData]):
    """All nodes of the server: those of the standard and the types as they were made, and those of the site."""

    def __init__(
        self,
        made: MutableMapping[ua.NodeId, NodeData],
        namespace: int,
        site: str,
        trays: Sequence[TrayConfig],
        value_of: ValueOf,
    ) -> None:
        self._made = made
        self._site = site
        self._namespace = namespace
        self._trays = {tray.name: tray for tray in trays}
        self._value_of = value_of
        self._templates = templates(namespace)
        self._recent: OrderedDict[str, SiteNode] = OrderedDict()
        self.subscribed: dict[str, SiteNode] = {}
        """the nodes to which somebody subscribes"""

    def __getitem__(self, nodeid: ua.NodeId) -> NodeData:
        if nodeid.NamespaceIndex != self._namespace or not isinstance(nodeid.Identifier, str):
            return self._made[nodeid]
        name = nodeid.Identifier
        node = self.subscribed.get(name) or self._recent.get(name)
        if node is None:
            node = self._recent[name] = self._make(name)
            if len(self._recent) > _KEPT:
                self._recent.popitem(last=False)
        return node

    def __setitem__(self, nodeid: ua.NodeId, node: NodeData) -> None:
        self._made[nodeid] = node

    def __delitem__(self, nodeid: ua.NodeId) -> None:
        del self._made[nodeid]

    def __iter__(self) -> Iterator[ua.NodeId]:
        return iter(self._made)

    def __len__(self) -> int:
        return len(self._made)

    def __contains__(self, nodeid: object) -> bool:
        return nodeid in self._made or (isinstance(nodeid, ua.NodeId) and self._is_of_site(nodeid))

    def fan(self, nodeid: ua.NodeId) -> tuple[Fan, str] | None:
        """The fan to which a node belongs, and the path below it; None: it belongs to none."""
        found = fan_of(nodeid.Identifier) if nodeid.NamespaceIndex == self._namespace else None
        if found is None:
            return None
        fan, path = found
        tray = self._trays.get(fan.tray)
        return found if tray is not None and fan.number < tray.fans and path in self._templates else None

    def tray(self, nodeid: ua.NodeId) -> str:
        """The tray of which a node is the folder; empty: it is none."""
        name = nodeid.Identifier if nodeid.NamespaceIndex == self._namespace else None
        return name if isinstance(name, str) and name in self._trays else ""

    def trays_in_folder(self) -> list[ua.ReferenceDescription]:
        """The references of the site's folder to its trays."""
        return [self._to_tray(name, is_forward=True) for name in self._trays]

    def _is_of_site(self, nodeid: ua.NodeId) -> bool:
        return bool(self.tray(nodeid)) or self.fan(nodeid) is not None

    def _make(self, name: str) -> SiteNode:
        nodeid = ua.NodeId(name, self._namespace)
        if name in self._trays:
            browse_name = ua.QualifiedName(name, ua.UInt16(self._namespace))
            attributes = self._named(self._templates[""].attributes, nodeid, browse_name)
            return SiteNode(nodeid, attributes, lambda: self._of_tray(name), None, self._watch)
        found = self.fan(nodeid)
        if found is None:
            raise KeyError(nodeid)
        fan, path = found
        template = self._templates[path]
        browse_name = template.browse_name if path else self._fan_name(fan)
        attributes = self._named(template.attributes, nodeid, browse_name)
        value = (lambda: self._value_of(fan, path, template.kind)) if template.kind else None
        return SiteNode(nodeid, attributes, lambda: self._of_fan(fan, template), value, self._watch)

    def _watch(self, node: SiteNode) -> None:
        name = str(node.nodeid.Identifier)
        if node.attributes.is_watched:
            self.subscribed[name] = node
        else:
            self.subscribed.pop(name, None)

    def _fan_name(self, fan: Fan) -> ua.QualifiedName:
        return ua.QualifiedName(f"Fan{fan.number}", ua.UInt16(self._namespace))

    def _named(
        self, attributes: Mapping[ua.AttributeIds, ua.DataValue], nodeid: ua.NodeId, browse_name: ua.QualifiedName
    ) -> dict[ua.AttributeIds, ua.DataValue]:
        return {
            **attributes,
            ua.AttributeIds.NodeId: ua.DataValue(ua.Variant(nodeid, ua.VariantType.NodeId)),
            ua.AttributeIds.BrowseName: ua.DataValue(ua.Variant(browse_name)),
            ua.AttributeIds.DisplayName: ua.DataValue(ua.Variant(ua.LocalizedText(browse_name.Name))),
        }

    def _of_tray(self, name: str) -> list[ua.ReferenceDescription]:
        fan_type = self._templates[""].type
        fans = [
            _reference(
                standard("Organizes"),
                ua.NodeId(f"{name}/{number}", self._namespace),
                self._fan_name(Fan(name, number)),
                ua.NodeClass.Object,
                fan_type,
            )
            for number in range(self._trays[name].fans)
        ]
        folder = ua.QualifiedName(self._site, ua.UInt16(self._namespace))
        site = ua.NodeId(SITE_FOLDER, self._namespace)
        parent = _reference(
            standard("Organizes"), site, folder, ua.NodeClass.Object, standard("FolderType"), is_forward=False
        )
        return [_type_reference(standard("FolderType"), "FolderType", 0), parent, *fans]

    def _to_tray(self, name: str, *, is_forward: bool) -> ua.ReferenceDescription:
        browse_name = ua.QualifiedName(name, ua.UInt16(self._namespace))
        target = ua.NodeId(name, self._namespace)
        folder = standard("FolderType")
        return _reference(
            standard("Organizes"), target, browse_name, ua.NodeClass.Object, folder, is_forward=is_forward
        )

    def _of_fan(self, fan: Fan, template: Template) -> list[ua.ReferenceDescription]:
        made = self._made.get(template.type)
        name = made.attributes[ua.AttributeIds.BrowseName].value.Value.Value if made else ua.QualifiedName()  # type: ignore[union-attr]
        found = [_type_reference(template.type, name.Name, name.NamespaceIndex)]
        if template.path:
            found.append(self._to(fan, template.path.rpartition("/")[0], template.by, is_forward=False))
        else:
            found.append(self._to_tray(fan.tray, is_forward=False))
        found += [self._to(fan, path, self._templates[path].by) for path in template.children]
        if not template.path:
            found.append(self._to(fan, "Alarm", standard("HasCondition")))
        return found + [self._to_method(node) for node in template.methods]

    def _to(self, fan: Fan, path: str, by: ua.NodeId, *, is_forward: bool = True) -> ua.ReferenceDescription:
        template = self._templates[path]
        target = ua.NodeId(f"{fan}/{path}" if path else str(fan), self._namespace)
        browse_name = template.browse_name if path else self._fan_name(fan)
        return _reference(by, target, browse_name, template.node_class, template.type, is_forward=is_forward)

    def _to_method(self, node: ua.NodeId) -> ua.ReferenceDescription:
        browse_name = self._made[node].attributes[ua.AttributeIds.BrowseName].value.Value.Value  # type: ignore[union-attr]
        return _reference(standard("HasComponent"), node, browse_name, ua.NodeClass.Method, ua.NodeId())


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
