"""`fantwin status --wear`, `fantwin info --wear`: how fast each fan wears, and when that will raise an alarm."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import typer
from rich.markup import escape
from rich.table import Table

from fantwin.pipeline.bus.session import join_bus
from fantwin.pipeline.cli.printing import show, table_of
from fantwin.pipeline.cli.progress import working
from fantwin.pipeline.cli.watch.scorers import wait_for_stages
from fantwin.pipeline.config.roles import roles_of
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.dates import format_local, has_date
from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.runtime.signals import stop_on_signals
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.codec import CodecError, decode
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import ScorerSnapshot
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.wear.recorded_wear import wear_in, wear_rows
from fantwin.scoring.wear.slow_change import LIMIT_SHARE

NS_PER_DAY = 86_400 * NS_PER_S
_NEEDED = "a fan has its first point about an hour after commissioning, while it turns without an alarm"


def show_wear_of_site(settings: Config, *, json_output: bool) -> None:
    """Show how the speed of each fan has changed since commissioning, how fast, and when its limit will be reached
    (docs/explanation/wear.md), by the last snapshot that each scorer has sent: at most a minute or 3,000 samples ago,
    for a tray of more than 64 fans three times as long.

    Raises:
        UserError: nothing is known.
    """
    stop = stop_on_signals()
    with join_bus(settings, listens=False) as bus:
        watcher = SiteWatcher(bus, settings.site, roles_of(settings))
        wait_for_stages(bus, watcher, settings, stop, what="wear")
        answers = bus.recover(tray_key(settings.site, "*", "snapshot"))
        heard = [(key, snapshot) for key, payload in answers for snapshot in _decoded(payload)]
        snapshots = [snapshot for key, snapshot in heard if watcher.counts(key, snapshot.header.producer)]
    nothing = "no scorer has recorded wear so far: it does so regularly; try again later"
    _show(snapshots, {tray.name: tray.names for tray in settings.trays}, nothing, json_output=json_output)


def show_recorded_wear(recordings: Sequence[Path], *, json_output: bool) -> None:
    """The same up to the end of the recordings; of several, the last of each tray.

    Raises:
        UserError: nothing is known.
        typer.Exit: 3, a recording could not be read in full.
    """
    snapshots, names, damage = _recorded(recordings)
    nothing = f"no wear in {', '.join(map(str, recordings))}: a scorer records it regularly and when it stops"
    _show(snapshots, names, nothing, json_output=json_output)
    for line in damage:
        typer.echo(line, err=True)
    if damage:
        raise typer.Exit(3)


def _show(
    snapshots: Sequence[ScorerSnapshot], names: Mapping[str, FanNames], nothing: str, *, json_output: bool
) -> None:
    latest = {each.header.tray: each for each in sorted(snapshots, key=lambda each: (each.t_ns, each.header.sequence))}
    last = [(tray, snapshot.t_ns, wear_in(snapshot)) for tray, snapshot in sorted(latest.items())]
    found = [(tray, t_ns, wear, names.get(tray, NO_NAMES)) for tray, t_ns, wear in last if wear is not None]
    if not found:
        raise UserError(nothing)
    rows = [row for each in found for row in wear_rows(*each)]
    if not rows:
        trays = ", ".join(tray for tray, *_ in found)
        raise UserError(f"no data yet for any fan of {trays}: {_NEEDED}; try again later")
    show({"wear": rows}, *(_table(*each) for each in found), json_output=json_output)


def _recorded(recordings: Iterable[Path]) -> tuple[list[ScorerSnapshot], dict[str, FanNames], list[str]]:
    snapshots, names, damage = [], {}, []
    with working(f"reading {', '.join(map(str, recordings))}"):
        for path in recordings:
            reading = read_recording(path, {"snapshot"})
            snapshots += [entry.message for entry in reading if isinstance(entry.message, ScorerSnapshot)]
            damage += [reading.damage] if reading.damage else []
            about = read_metadata(path)
            names |= {tray: about.names(tray) for tray in about.trays}
    return snapshots, names, damage


def _decoded(payload: bytes) -> list[ScorerSnapshot]:
    """Unreadable messages are skipped here; the stages count them."""
    try:
        return [decode(ScorerSnapshot, payload)]
    except CodecError:
        return []


def _table(tray: str, t_ns: int, state: dict[str, Any], names: FanNames) -> Table:
    rows = wear_rows(tray, t_ns, state)
    without = sorted(set(range(len(state["fans"]))) - {row["fan"] for row in rows})
    limit = f"{100 * LIMIT_SHARE:.0f} %"
    caption = ["% of the speed, ± 95 %, since commissioning; beside: the change of the fans beside it"]
    caption += [f"no data yet for {escape(names.labels(without))}: {_NEEDED}"] if without else []
    title, reached = f"wear of {escape(tray)} up to {_minute(t_ns)}", f"{limit} reached"
    columns = ("fan", "at"), ("change", "beside", "per day"), (reached,)
    table = table_of(*columns, title=title, caption="\n".join(caption), padding=(0, 0, 0, 1))
    for row in rows:
        per_day, beside = row["per_day"], row["beside"]
        significant = per_day and not per_day["low"] <= 0.0 <= per_day["high"]
        table.add_row(
            escape(names.cell(row["fan"])),
            _minute(row["seen_t_ns"], "%m-%d %H:%M"),
            _percent(row["change"], 1.96 * row["change_std_error"]),
            "" if beside is None else f"{100 * beside:+.1f}",
            _percent(per_day["value"], (per_day["high"] - per_day["low"]) / 2) if per_day else "no trend yet",
            _forecast(row),
            style="" if significant else "dim",
        )
    return table


def _minute(t_ns: int, form: str = "%Y-%m-%d %H:%M") -> str:
    return datetime.fromtimestamp(t_ns / NS_PER_S).strftime(form) if has_date(t_ns) else format_local(t_ns)


def _percent(share: float, half_interval: float) -> str:
    """Both with the digits that say something."""
    places = max(0, 1 - math.floor(math.log10(100 * max(half_interval, 1e-6))))
    return f"{100 * share:+.{places}f} ± {100 * half_interval:.{places}f}"


def _forecast(row: dict[str, Any]) -> str:
    """When the limit is reached, from the time at which the values hold."""
    reached = row["reached_t_ns"]
    if reached is None:
        return str(row["unknown_reason"])
    earliest, likely, latest = (
        max(reached[name] - row["seen_t_ns"], 0) / NS_PER_DAY for name in ("earliest", "likely", "latest")
    )
    return f"in {likely:.0f} days ({earliest:.0f} to {latest:.0f})"
