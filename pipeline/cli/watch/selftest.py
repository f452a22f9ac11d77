"""`fantwin doctor selftest`: causes common faults on a site of its own; prints each promise and what it saw."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.console import Console
from rich.text import Text

from fantwin.pipeline.cli.printing import show, table_of
from fantwin.pipeline.cli.progress import working
from fantwin.pipeline.cli.simulation.scenario import Scenario as Simulated
from fantwin.pipeline.config.settings import nearest
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.selftest.scenarios import SCENARIOS, Scenario
from fantwin.pipeline.selftest.scratch_site import FANS
from fantwin.pipeline.selftest.selftest import Row, run_scenarios
from fantwin.schemas.tacho import INSTANTANEOUS

if TYPE_CHECKING:
    from fantwin.simulation.tray import SimulatedTray

_STATES = {True: "kept", False: "NOT KEPT", None: "not run"}
_STYLES = {True: "green", False: "red", None: "yellow"}


def run_selftest(names: Sequence[str], out: Path | None, *, json_output: bool) -> None:
    """Kill, freeze and flood the stages of a simulated site, and check that fantwin keeps its promises.

    names: of scenarios; empty for all. out: folder for the files; None: a temporary one.

    Raises:
        UserError: there is no such scenario, or the folder is not empty.
        typer.Exit: a promise was not kept.
    """
    chosen = _chosen(names)
    console = Console(stderr=json_output, highlight=False, soft_wrap=True)
    with tempfile.TemporaryDirectory(prefix="fantwin-selftest-") as temporary:
        folder = out.resolve() if out else Path(temporary)
        if out and out.exists() and any(out.iterdir()):
            raise UserError(f"{out}: is not empty; name a new folder with -o")
        with working(f"running {len(chosen)} scenarios"):
            rows: list[Row] = []
            for row in run_scenarios(folder, chosen, simulated_tray):
                console.print(f"{_STATES[row.kept]:8}  {row.name}: {row.seen}", markup=False)
                rows.append(row)
    is_kept = all(row.kept is not False for row in rows)
    table = table_of([""], (), ("scenario", "promised", "seen"))
    for row in rows:
        table.add_row(Text(_STATES[row.kept], style=_STYLES[row.kept]), row.name, row.promise, row.seen)
    show({"rows": [asdict(row) for row in rows], "kept": is_kept}, table, json_output=json_output)
    if not is_kept:
        raise typer.Exit(1)


def simulated_tray() -> SimulatedTray:
    """The device of a scratch site."""
    return Simulated(fans=FANS).tray(INSTANTANEOUS, rate_hz=100.0)


def _chosen(names: Sequence[str]) -> list[Scenario]:
    by_name = {scenario.name: scenario for scenario in SCENARIOS}
    for name in names:
        if name not in by_name:
            known = nearest(name, by_name) or f"; known: {', '.join(by_name)}"
            raise UsageError(f"no scenario {name!r}{known}")
    return [by_name[name] for name in names] or list(SCENARIOS)
