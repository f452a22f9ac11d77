"""`fantwin selftest`: causes common faults on a site of its own; prints each promise and what it saw."""

from __future__ import annotations

import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.text import Text

from fantwin.pipeline.cli.options import JsonOption
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


def selftest(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SCENARIO]...", help=f"Default: all of {', '.join(scenario.name for scenario in SCENARIOS)}."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder for the files; default: a temporary one.")
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Kill, freeze and flood the stages of a simulated site, and check that fantwin keeps its promises.

    It leaves running sites alone: it uses its own port and folder on this computer. It takes about three minutes.
    Exit code 1 if a promise was not kept.

    Example: fantwin selftest

    Example: fantwin selftest kill hang
    """
    chosen = _chosen(names or ())
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


def _chosen(names: list[str] | tuple[str, ...]) -> list[Scenario]:
    by_name = {scenario.name: scenario for scenario in SCENARIOS}
    for name in names:
        if name not in by_name:
            raise UsageError(f"no scenario {name!r}{nearest(name, by_name)}")
    return [by_name[name] for name in names] or list(SCENARIOS)
