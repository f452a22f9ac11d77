"""`fantwin recover`: a torn recording becomes whole again."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from pipeline.cli.options import JsonOption
from pipeline.cli.progress import working
from pipeline.recordings.contents import losses, messages_as_text
from pipeline.recordings.repair import Recovery
from pipeline.recordings.repair import recover as recover_file
from pipeline.recordings.scan import Scan
from pipeline.recordings.sequence_ledger import StreamCounts, add_up


def recover(
    file: Annotated[Path, typer.Argument(metavar="TORN.mcap", help="What a killed recorder or a bad disk has left.")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="WHOLE.mcap", help="Recording to write; without it, in place."),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Make a torn recording whole again (end, index, statistics, ledger), and say what is in it and what is missing.

    Without -o the whole recording takes the name of the torn one, which is kept beside it as TORN.mcap.torn. Exit code
    0: nothing was lost; 3: something was; 1: nothing could be recovered.

    Example: fantwin recover runs/recording.mcap.active
    """
    with working(f"reading {file}"):
        recovery = recover_file(file, output)
    if json_output:
        typer.echo(json.dumps(as_json(file, recovery)))
    else:
        for line in _lines(file, recovery):
            typer.echo(line)
    if losses(recovery.found):
        raise typer.Exit(3)


def _lines(file: Path, recovery: Recovery) -> list[str]:
    found = recovery.found
    if found.is_whole:
        copied = f"; copied to {recovery.path}" if recovery.path != file else ""
        lines = [f"{file}: is whole already, with {messages_as_text(found.messages)}; nothing to recover{copied}"]
    else:
        kept = f"; the torn file is {recovery.torn}" if recovery.torn else ""
        lines = [f"{file}: {messages_as_text(found.messages)} are whole again in {recovery.path}{kept}"]
    for topic, account in _by_topic(found).items():
        last = f", the last at {_time(account.last_ns)}" if account.last_ns is not None else ""
        missing = f", {account.missing} missing" if account.missing else ""
        lines.append(f"  {topic}: {messages_as_text(account.messages)}{missing}{last}")
    lost = losses(found)
    return lines + (["lost:", *(f"  {line}" for line in lost)] if lost else ["nothing was lost"])


def as_json(file: Path, recovery: Recovery) -> dict[str, Any]:
    """What a machine is told."""
    found = recovery.found
    unrecorded = {} if found.is_ended else found.census.ledger.unrecorded()
    return {
        "file": str(file),
        "whole": str(recovery.path),
        "torn": str(recovery.torn) if recovery.torn else None,
        "was_whole": found.is_whole,
        "had_ended": found.is_ended,
        "messages": found.messages,
        "topics": {
            topic: {
                "messages": account.messages,
                "missing": account.missing,
                "duplicated": account.duplicated,
                "first_ns": account.first_ns,
                "last_ns": account.last_ns,
            }
            for topic, account in _by_topic(found).items()
        },
        "published_after_the_last": {f"{key} {producer}": count for (key, producer), count in unrecorded.items()},
        "thrown_away_bytes": found.thrown_away_bytes,
        "damaged_chunks": found.damaged_chunks,
        "damaged_attachments": found.damaged_attachments,
        "damaged_records": found.damaged_records,
        "lost": losses(found),
    }


def _by_topic(found: Scan) -> dict[str, StreamCounts]:
    return add_up(found.accounts.items()) | found.census.others


def _time(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns / 1e9).isoformat(sep=" ", timespec="milliseconds")
