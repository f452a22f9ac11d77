"""The rows of registries, and how other packages add theirs: by entry points.

In the `pyproject.toml` of a package, the name of the kind and where its row is:

    [project.entry-points."fantwin.sources"]
    anemometer = "fantwin_anemometer:KIND"

A row is data. Its module imports it from here and nothing heavy, since every process reads it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Container
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, NamedTuple, TypeVar

from fantwin.pipeline.errors import UserError

_LOG = logging.getLogger(__name__)
Row = TypeVar("Row")
LEFT_OUT: set[str] = set()
"""names of what could not be used, which was said"""


class SourceKind(NamedTuple):
    """Import strings, `module:class`. The settings are apart: every process reads them, only acquisition connects."""

    config: str
    """a `SourceConfig`"""
    source: str
    """a `SampleSource`, built from that configuration and a `SourceContext`"""


@dataclass(frozen=True)
class StageRow:
    """What is known about a stage without importing it.

    Attributes:
        name: also the name of its section in the configuration.
        declaration: import string of its `pipeline.runtime.stage.Stage`, `module:attribute`.
        enabled_by: what enables it where `launcher.stages` is not given. "default": always; "section": a section
            `[name]` in the configuration; "tray without twin": a tray that names no twin.
        extra: the extra of the installation that it needs. If it is missing, `fantwin up` leaves out the stage, unless
            `launcher.stages` names it.
        scope: one process for the site, or one for each tray, where `launcher.shards` says nothing of it. Only stages
            with a process for each tray may have a device.
        has_common_shards: a `launcher.shards` that is one number for all stages applies to it.
        may_drop: it may drop messages: those that it misses do not count as losses.
        reads: topics. The first is the main input, the only one that advances the input position of outputs.
        writes: topics.
        keeps: topics whose last message about each of its trays it keeps for others, also when the producer has gone.
        needs_twin: it cannot start unless every tray has a twin, or learns one.
    """

    name: str
    declaration: str
    enabled_by: Literal["default", "section", "tray without twin"] = "section"
    extra: str = ""
    scope: Literal["site", "tray"] = "site"
    has_common_shards: bool = True
    may_drop: bool = False
    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    keeps: tuple[str, ...] = ()
    needs_twin: bool = False

    def load(self) -> Any:
        """Import the stage and return its declaration.

        Raises:
            UserError: it cannot be imported.
        """
        return loaded(self.declaration)


def loaded(import_string: str) -> Any:
    """What `module:attribute` names.

    Raises:
        UserError: it cannot be imported.
    """
    module, _, attribute = import_string.partition(":")
    try:
        return getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        if module.startswith("fantwin."):
            raise
        raise UserError(f"{import_string} cannot be imported ({error}): correct or uninstall its package") from error


def rows_of_others(
    group: str, kind: type[Row], own: Container[str], why_not: Callable[[str, Row], str] = lambda _name, _row: ""
) -> dict[str, Row]:
    """The rows of other packages by their names.

    What cannot be used is left out, with one line on standard error: a broken package must not stop a plant that does
    not need it.

    Args:
        group: of entry points.
        kind: of a row.
        own: names that are taken.
        why_not: what is wrong with a row of this name; empty: nothing.
    """
    found: dict[str, Row] = {}
    for point in entry_points(group=group):
        try:
            row = point.load()
        except (Exception, SystemExit) as error:  # noqa: BLE001  whatever a module of others raises when it is imported
            problem = f"{type(error).__name__}: {error}"
        else:
            if not isinstance(row, kind):
                problem = f"it is no {kind.__name__}"
            else:
                problem = "this name is taken" if point.name in own or point.name in found else why_not(point.name, row)
                if not problem:
                    found[point.name] = row
                    continue
        LEFT_OUT.add(point.name)
        _LOG.warning("%s %r is left out: %s; correct or uninstall %s", group, point.name, problem, _package(point))
    return found


def _package(point: EntryPoint) -> str:
    return f"the package {point.dist.name}" if point.dist else "its package"
