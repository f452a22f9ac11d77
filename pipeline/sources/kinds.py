"""The kinds of sources, and the only place that lists them. Other packages add theirs by entry points of the group
`fantwin.sources`.

A row holds import strings, so that a process imports the source that its configuration names and no other.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fantwin.pipeline.plugins import SourceKind, loaded, rows_of_others
from fantwin.pipeline.sources.source import SampleSource, SourceConfig, SourceContext

_OWN = ("serial", "mqtt", "http", "push", "hwmon", "modbus", "redfish", "exec", "prometheus", "ipmi", "snmp")
"""of each a folder beside this file: `config` has its settings, MqttConfig, and `source` its source, MqttSource"""
SOURCE_KINDS = {
    kind: SourceKind(
        config=f"fantwin.pipeline.sources.{kind}.config:{kind.title()}Config",
        source=f"fantwin.pipeline.sources.{kind}.source:{kind.title()}Source",
    )
    for kind in _OWN
}
SOURCE_KINDS |= rows_of_others("fantwin.sources", SourceKind, SOURCE_KINDS)


def parse_source(values: Any) -> SourceConfig:
    """The settings of a source, checked by the model of its `kind`.

    Raises:
        ValueError: no such kind, or an unknown key.
        ValidationError: a wrong value.
    """
    if isinstance(values, SourceConfig):
        return values
    if not isinstance(values, Mapping) or "kind" not in values:
        raise ValueError(f'write source = {{ kind = "...", ... }}; kinds: {", ".join(SOURCE_KINDS)}')
    kind = values["kind"]
    if not isinstance(kind, str) or kind not in SOURCE_KINDS:
        raise ValueError(f"unknown kind {kind!r}; known: {', '.join(SOURCE_KINDS)}")
    model = source_config(kind)
    for key in values:
        if key not in model.model_fields:
            raise ValueError(f"unknown key {key!r} of kind {kind!r}; known: {', '.join(model.model_fields)}")
    return model.model_validate(values)


def source_config(kind: str) -> type[SourceConfig]:
    """The model of the settings of a kind."""
    return loaded(SOURCE_KINDS[kind].config)


def build_source(config: SourceConfig, context: SourceContext) -> SampleSource:
    """The source of these settings, not yet started.

    Raises:
        UserError: a setting is missing or cannot be used.
    """
    return loaded(SOURCE_KINDS[config.kind].source)(config, context)
