"""`fantwin info --repair`: repairs a truncated or damaged recording."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import typer

from fantwin.pipeline.cli.progress import working
from fantwin.pipeline.recordings.contents import losses, messages_as_text
from fantwin.pipeline.recordings.dates import format_local
from fantwin.pipeline.recordings.repair import Recovery
from fantwin.pipeline.recordings.repair import recover as recover_file
from fantwin.pipeline.recordings.scan import Scan
from fantwin.pipeline.recordings.sequence_ledger import StreamCounts, sum_by_key


def repair(file: Path, output: Path | None, *, json_output: bool) -> None:
    """Repair a truncated or damaged recording, and print what it contains and what is missing.

    output: without it the repaired recording takes the name of `file`, which is kept as `file`.original.

    Raises:
        UserError: nothing can be recovered, or it cannot be written.
        typer.Exit: data were lost, or may have been.
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
    if found.is_intact:
        copied = f"; copied to {recovery.path}" if recovery.path != file else ""
        lines = [f"{file}: intact, with {messages_as_text(found.messages)}; nothing to recover{copied}"]
    else:
        kept = f"; the original is kept as {recovery.original}" if recovery.original else ""
        lines = [f"{file}: {messages_as_text(found.messages)} recovered in {recovery.path}{kept}"]
    for topic, counts in _by_topic(found).items():
        last = f", the last at {format_local(counts.last_ns)}" if counts.last_ns is not None else ""
        missing = f", {counts.missing} missing" if counts.missing else ""
        lines.append(f"  {topic}: {messages_as_text(counts.messages)}{missing}{last}")
    lost = losses(found)
    return lines + (["lost:", *(f"  {line}" for line in lost)] if lost else ["nothing was lost"])


def as_json(file: Path, recovery: Recovery) -> dict[str, Any]:
    """The output of --json."""
    found = recovery.found
    unrecorded = {} if found.is_ended else found.counts.ledger.unrecorded()
    return {
        "file": str(file),
        "output": str(recovery.path),
        "original": str(recovery.original) if recovery.original else None,
        "was_intact": found.is_intact,
        "had_ended": found.is_ended,
        "messages": found.messages,
        "topics": {
            topic: {
                "messages": counts.messages,
                "missing": counts.missing,
                "duplicated": counts.duplicated,
                "first_ns": counts.first_ns,
                "last_ns": counts.last_ns,
            }
            for topic, counts in _by_topic(found).items()
        },
        "published_after_the_last": {f"{key} {producer}": count for (key, producer), count in unrecorded.items()},
        "discarded_bytes": found.discarded_bytes,
        "damaged_chunks": found.damaged_chunks,
        "damaged_attachments": found.damaged_attachments,
        "damaged_records": found.damaged_records,
        "lost": losses(found),
    }


def _by_topic(found: Scan) -> dict[str, StreamCounts]:
    return sum_by_key(found.streams.items()) | found.counts.others
