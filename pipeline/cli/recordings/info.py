"""`fantwin info`: what a recording contains, and what is missing; repairs it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from fantwin.pipeline.cli.options import JsonOption
from fantwin.pipeline.cli.printing import table_of
from fantwin.pipeline.cli.progress import working
from fantwin.pipeline.cli.watch.wear import show_recorded_wear
from fantwin.pipeline.config.registry import RECORDER
from fantwin.pipeline.errors import UsageError
from fantwin.pipeline.recordings.clips.clip import clip_lines
from fantwin.pipeline.recordings.contents import contents_of, continuity, losses_of, messages_as_text
from fantwin.pipeline.recordings.dates import format_clock, format_local
from fantwin.pipeline.recordings.metadata import CONFIGURATION
from fantwin.pipeline.recordings.reading import NAMES_KEY, left_out_of, read_recording
from fantwin.pipeline.recordings.records import active_path
from fantwin.pipeline.recordings.repair import recover as recover_file
from fantwin.pipeline.recordings.run_recordings import RECORDING_KEY, recorded_files
from fantwin.pipeline.recordings.scan import NO_LOSS, STILL_WRITTEN, Contents
from fantwin.pipeline.recordings.sequence_ledger import StreamCounts, sum_by_key
from fantwin.pipeline.site.loss_accounting import label, losses, refused, refused_lines
from fantwin.pipeline.site.stage_states import note_lines, notes_as_json
from fantwin.schemas.fan_names import FanNames
from fantwin.schemas.health import Health
from fantwin.schemas.messages import ModelCard, Raw
from fantwin.schemas.streams import StreamId
from fantwin.schemas.twin_card import CardError, TwinCard
from fantwin.schemas.units import NS_PER_S

_WIDEST = 1000
"""columns of a table; a terminal that is narrower wraps its lines, and every name can be copied and searched for"""


def info(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="A recording, the parts of one, or a run folder.")
    ],
    repaired: Annotated[
        bool, typer.Option("--repair", help="Repair a truncated or damaged recording, which is kept as FILE.original.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="NEW.mcap", help="With --repair: write here, and leave FILE alone."),
    ] = None,
    wear: Annotated[
        bool, typer.Option("--wear", help="Only how each fan had changed by the end, and how fast.")
    ] = False,
    json_output: JsonOption = False,
) -> None:
    """Show what a recording contains: time, trays, twins, messages and losses of each topic, problems of stages.

    With --repair, a truncated or damaged recording is made whole, and what was lost is listed.

    With several parts, it also checks that each continues the one before. A file without an index is read in full, as
    far as possible; one that is still being written, up to its last flush. Exit code 3 if messages are missing or a
    file is damaged.

    The recordings of the shards of a recorder are those of one run: name all, or the run folder.

    Example: fantwin info runs/recording.mcap

    Example: fantwin info --repair runs/recording.mcap.active
    """
    if repaired:
        if len(files) > 1:
            raise UsageError("--repair repairs one recording: name one")
        repair(files[0], output, json_output=json_output)
        return
    if wear:
        show_recorded_wear(files, json_output=json_output)
        return
    if output:
        raise UsageError("-o is for --repair: nothing else is written")
    with working(f"reading {', '.join(str(file) for file in files)}"):
        present = recorded_files(map(_present, files), with_unfinished=True)
        parts = sorted(map(_contents, present), key=lambda part: part.first_ns or 0)
    breaks = continuity(parts)
    if json_output:
        typer.echo(json.dumps(as_json(parts, breaks)))
    else:
        _show(parts, breaks)
    if breaks or any(_has_lost(part) for part in parts):
        raise typer.Exit(3)


def _present(file: Path) -> Path:
    """The file, or its active name if it is still being written."""
    return active_path(file) if not file.exists() and active_path(file).exists() else file


def _contents(file: Path) -> Contents:
    """What is in a file. One whose messages were all received at one time begins with its first raw sample."""
    part = contents_of(file)
    if part.first_ns is None or part.first_ns != part.last_ns:
        return part
    raws = (each.message for each in read_recording(file, ("raw",)))
    times = [int(raw.host_receive_t_ns[0]) for raw in raws if isinstance(raw, Raw) and len(raw.host_receive_t_ns)]
    return replace(part, first_ns=min((part.first_ns, *times)))


def _sessions(parts: Iterable[Contents]) -> list[Health]:
    """The last health of each session in all parts; recordings of two shards may both have some of a session."""
    sessions: dict[str, Health] = {}
    for health in (health for part in parts for health in part.sessions):
        before = sessions.pop(health.header.producer, health)
        is_newer = health.header.sequence >= before.header.sequence
        sessions[health.header.producer] = health if is_newer else before
    return list(sessions.values())


def _streams(parts: Iterable[Contents]) -> list[tuple[StreamId, StreamCounts]]:
    """The streams of all parts; of one that several recordings have, as that of the health of a stage, those of the
    recording that has most of it."""
    found: dict[StreamId, dict[str, list[StreamCounts]]] = {}
    for part in parts:
        recording = part.metadata.get(RECORDING_KEY, str(part.path))
        for stream, counts in part.streams.items():
            found.setdefault(stream, {}).setdefault(recording, []).append(counts)
    most = {
        stream: max(recorded.values(), key=lambda counts: sum(each.messages for each in counts))
        for stream, recorded in found.items()
    }
    return [(stream, each) for stream, counts in most.items() for each in counts]


def _losses(sessions: Iterable[Health]) -> dict[str, int]:
    """What the stages have lost. What a recorder lacks stands with the topics: the last health of a killed one in its
    recording is of before its last messages."""
    return losses(health for health in sessions if health.stage != RECORDER)


def as_json(parts: Sequence[Contents], breaks: Sequence[str]) -> dict[str, Any]:
    """The output of --json: each file, and the topics of all files together."""
    together = sum_by_key(_streams(parts))
    return {
        "files": [_part_as_json(part) for part in parts],
        "topics": {key: _counts_as_json(counts) for key, counts in together.items()},
        "continuity": list(breaks),
        "lost": _losses(_sessions(parts)),
        "refused": refused(_sessions(parts)),
    }


def _part_as_json(part: Contents) -> dict[str, Any]:
    lost = _losses(part.sessions)
    return {
        "file": str(part.path),
        "size_bytes": part.size_bytes,
        "messages": part.messages,
        "first_ns": part.first_ns,
        "last_ns": part.last_ns,
        "duration_s": _duration_s(part),
        "metadata": dict(part.metadata),
        "left_out": list(left_out_of(part.metadata)),
        "attachments": list(part.attachments),
        "has_configuration": CONFIGURATION in part.attachments,
        "twins": {
            _tray(key): {"twin": c.twin, "kind": c.kind, "sha256": c.sha256, "closed_loop": _is_closed_loop(c)}
            for key, c in part.cards.items()
        },
        "topics": {key: _counts_as_json(counts) for key, counts in sum_by_key(part.streams.items()).items()},
        "producers": [{"key": key, "producer": producer, **asdict(a)} for (key, producer), a in part.streams.items()],
        "other_topics": dict(part.others),
        "stages": {
            label(health): {
                "status": health.status.name.lower(),
                "problem": health.problem,
                "notes": notes_as_json(health),
                "lost": lost.get(label(health), health.lost),
                "counters": {counter.name: counter.value for counter in health.counters},
            }
            for health in part.healths
        },
        "recovered": list(part.recovered),
        "damage": list(part.damage),
    }


def _counts_as_json(counts: StreamCounts) -> dict[str, Any]:
    names = ("messages", "missing", "duplicated", "first_ns", "last_ns")
    return {name: getattr(counts, name) for name in names} | {"rate_hz": _rate_hz(counts)}


def _show(parts: Sequence[Contents], breaks: Iterable[str]) -> None:
    console = Console(soft_wrap=True, highlight=False, width=_WIDEST)

    def show(lines: Iterable[str], style: str = "") -> None:
        for line in lines:
            console.print(line, style=style, markup=False)

    for part in parts:
        first, *others = _about(part)
        show([first], "bold")
        show(others)
        if part.streams or part.others:
            console.print(_table(part))
        healths = sorted(part.healths, key=label)
        show(note_lines(healths))
        show((f"{label(health)}: {health.problem}" for health in healths if health.problem), "red")
        show((f"repaired earlier: {line}" for line in part.recovered), "red")
        advice = "; repair it with `fantwin info --repair`"
        show((line if line == STILL_WRITTEN else f"{line}{advice}" for line in part.damage), "red")
    show(breaks, "red")
    show(refused_lines(refused(_sessions(parts))), "yellow")
    lost = _losses(_sessions(parts))
    if any(lost.values()):
        by_stage = ", ".join(f"{name} {count}" for name, count in lost.items() if count)
        show([f"lost, over all sessions of each stage: {by_stage}"], "red")


def _about(part: Contents) -> list[str]:
    """The lines about a file above the table of its topics."""
    metadata = part.metadata
    lines = [f"{part.path}: {part.size_bytes / 1e6:,.2f} MB, {part.messages} messages"]
    if part.first_ns is not None and part.last_ns is not None:
        lines.append(f"from {format_local(part.first_ns)} to {format_local(part.last_ns)}: {_duration_s(part):,.1f} s")
    if not metadata and not part.streams:
        lines.append("not a fantwin recording: it has no fantwin channels")
    lines += clip_lines(metadata)
    if "part" in metadata:
        after = f", continues {metadata['continues']}" if "continues" in metadata else ""
        session, site = metadata.get("session", "?"), metadata.get("site", "?")
        lines.append(f"part {metadata['part']} of session {session}{after}, site {site}")
    with suppress(KeyError, ValueError, OverflowError):  # others may have metadata of these names
        gap_s = (int(metadata["resumed_t_ns"]) - int(metadata["paused_t_ns"])) / NS_PER_S
        lost, reason = metadata["lost_in_pause"], metadata["paused_because"]
        lines.append(f"before this part nothing was recorded for {gap_s:,.1f} s; messages lost: {lost}")
        lines.append(f"  reason: {reason}")
    for tray in filter(None, metadata.get("trays", "").split(",")):
        fans = f", {metadata[f'fans.{tray}']} fans" if f"fans.{tray}" in metadata else ""
        names = FanNames.from_json(metadata.get(f"{NAMES_KEY}.{tray}", "")).all_in_words()
        fans += f" ({names})" if names else ""
        lines.append(
            f"tray {tray}{fans}, speeds in {metadata.get(f'speed_unit.{tray}') or metadata.get('speed_unit', 'rad/s')}"
        )
    for key, card in part.cards.items():
        closed = ", closed loop: yes" if _is_closed_loop(card) else ""
        lines.append(f"twin of {_tray(key)}: {card.twin}, {card.kind}{closed}, sha256 {card.sha256[:12]}")
    if left_out := left_out_of(metadata):
        lines.append(f"left out on purpose (recorder.topics): {', '.join(left_out)}")
    if "source" in metadata:
        lines.append(f"made from: {metadata['source']}")
    if part.attachments:
        lines.append(f"attached: {', '.join(part.attachments)}")
    return lines


def _is_closed_loop(card: ModelCard) -> bool:
    try:
        return any(TwinCard.from_json(card.card_json).closed_loop)
    except CardError:  # of another format, or of no card
        return False


def _table(part: Contents) -> Table:
    columns = ("messages", "missing", "duplicated", "first", "last", "per s")
    table = table_of(["topic"], columns, padding=0, pad_edge=False, show_edge=False)
    for key, counts in sum_by_key(part.streams.items()).items():
        missing = f"[red]{counts.missing}[/red]" if counts.missing else "0"
        rate_hz = _rate_hz(counts)
        table.add_row(
            escape(key.split("/", 2)[2]),
            str(counts.messages),
            missing,
            str(counts.duplicated),
            *("" if t_ns is None else format_clock(t_ns) for t_ns in (counts.first_ns, counts.last_ns)),
            "" if rate_hz is None else f"{rate_hz:.1f}" if rate_hz >= 1.0 else f"{rate_hz:.2g}",
        )
    for topic, messages in sorted(part.others.items()):
        table.add_row(escape(topic), str(messages), "", "", "", "", "", style="dim")
    return table


def _has_lost(part: Contents) -> bool:
    has_missing = any(counts.missing for counts in part.streams.values())
    return has_missing or bool(part.recovered) or not NO_LOSS.issuperset(part.damage)


def _duration_s(part: Contents) -> float:
    return (part.last_ns - part.first_ns) / NS_PER_S if part.last_ns is not None and part.first_ns is not None else 0.0


def _rate_hz(counts: StreamCounts) -> float | None:
    if counts.first_ns is None or counts.last_ns is None or counts.last_ns - counts.first_ns < NS_PER_S:
        return None  # a few messages within a moment have no rate
    return (counts.messages - 1) / ((counts.last_ns - counts.first_ns) / NS_PER_S)


def _tray(key: str) -> str:
    return key.split("/")[2]


def repair(file: Path, output: Path | None, *, json_output: bool) -> None:
    """Repair a truncated or damaged recording, and print what the repaired one contains and what is missing.

    output: without it the repaired recording takes the name of `file`, which is kept as `file`.original.

    Raises:
        UserError: nothing can be recovered, or it cannot be written.
        typer.Exit: data were lost, or may have been.
    """
    with working(f"reading {file}"):
        recovery = recover_file(file, output)
        part = _contents(recovery.path)
    found, lost = recovery.found, losses_of(recovery.found)
    if json_output:
        original = str(recovery.original) if recovery.original else None
        about = {"file": str(file), "output": str(recovery.path), "original": original, "was_intact": found.is_intact}
        typer.echo(json.dumps(_part_as_json(part) | about | {"lost": lost}))
    else:
        if found.is_intact:
            copied = f"; copied to {recovery.path}" if recovery.path != file else ""
            typer.echo(f"{file}: intact, with {messages_as_text(found.messages)}; nothing to recover{copied}")
        else:
            kept = f"; the original is kept as {recovery.original}" if recovery.original else ""
            typer.echo(f"{file}: {messages_as_text(found.messages)} recovered in {recovery.path}{kept}")
        _show([replace(part, recovered=())], ())
        for line in ["lost:", *(f"  {line}" for line in lost)] if lost else ["nothing was lost"]:
            typer.echo(line)
    if lost:
        raise typer.Exit(3)
