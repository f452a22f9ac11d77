"""`fantwin replay`: play a recording on the bus, or score it again offline."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from fantwin.pipeline.cli.in_parallel import JobsOption, RecordingsInParallel, SkipBadOption
from fantwin.pipeline.cli.options import JsonOption, SetOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.cli.progress import Reporter
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.recordings.dates import format_utc
from fantwin.pipeline.recordings.left_out import left_out_hint
from fantwin.pipeline.recordings.remote import local_copies, matching, recording_path
from fantwin.pipeline.replay.live.keyboard import Keys
from fantwin.pipeline.replay.live.player import Pace, Progress
from fantwin.pipeline.replay.live.publishing import Outcome, publish
from fantwin.pipeline.replay.live.recording_playback import RecordingPlayback
from fantwin.pipeline.replay.resolve_config import resolve_config
from fantwin.pipeline.replay.stage_chain import replay_starts
from fantwin.pipeline.runtime.signals import stop_on_signals
from fantwin.schemas.topics import TOPICS

REPLAYED = tuple(topic.name for topic in TOPICS if topic.recorded and not topic.is_of_session)
"""the topics replayed by default"""
_KEYS_HELP = "space pause, → step, ↑↓ rate, q quit"
_SHOWN_EVERY_S = 0.1
LARGEST_RATE = 1e6
LONGEST_S = 1e10
"""three centuries, which still fits in ns"""


def replay(
    files: Annotated[
        list[Path],
        typer.Argument(
            parser=recording_path,
            callback=matching,
            metavar="FILE",
            help="Parts of one run, in any order, or a run folder; offline, of many.",
        ),
    ],
    rate: Annotated[
        str | None, typer.Option(metavar="X|max", help="Seconds of the recording per second; max: as fast as possible.")
    ] = None,
    start: Annotated[float, typer.Option("--from", metavar="S", help="Start, in s since the first message.")] = 0.0,
    end: Annotated[float, typer.Option("--to", metavar="S", help="End, in s since the first message.")] = math.inf,
    pause: Annotated[bool, typer.Option("--pause", help="Start paused; space continues.")] = False,
    loop: Annotated[bool, typer.Option("--loop", help="Repeat until Ctrl-C; times continue.")] = False,
    topics: Annotated[
        str | None, typer.Option(metavar="A,B", help="Topics to publish. Default: all of the trays.")
    ] = None,
    from_topic: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC",
            help="Publish only the input of the stages that read TOPIC (raw, grid or prediction), and learned twins.",
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            "-c",
            "--config",
            help="Configuration file (TOML) with site, trays and bus. Default: the one in the recording; for an "
            "imported table, which has none, its site and trays.",
        ),
    ] = None,
    overrides: SetOption = None,
    json_output: JsonOption = False,
    offline: Annotated[
        bool, typer.Option("--offline", help="Score recordings again, in this process and without a bus.")
    ] = False,
    twin: Annotated[Path | None, typer.Option(metavar="TWIN.onnx", help="Offline: score with another twin.")] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="OUT.mcap", help="Offline: write a new recording.")
    ] = None,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify", help="Offline: compare with the recorded result, decisions exactly, numbers within a tolerance."
        ),
    ] = False,
    jobs: JobsOption = None,
    skip_bad: SkipBadOption = False,
) -> None:
    """Publish a recording on the bus in recorded time, for the viewer or the stages; or score recordings again offline.

    In a terminal: space pauses, right arrow or s steps to the next sample, up and down double and halve the rate, q
    quits. Topics that a running stage writes are not published. Exit code 3 if a stage lost messages or part of the
    recording could not be read.

    With --offline, files of many recordings can be given: they are scored at once, and one result covers them all.

    Example: fantwin replay recording.mcap --rate 4 --from-topic raw -c fantwin.toml

    Example: fantwin replay --offline --verify site-*/*.mcap
    """
    viewing = {"--rate": rate, "--pause": pause, "--loop": loop, "--topics": topics, "--from-topic": from_topic}
    deciding = {"--twin": twin, "--output": output, "--verify": verify}
    deciding |= {"--jobs": jobs, "--skip-bad": skip_bad}
    for name in (name for name, value in (viewing if offline else deciding).items() if value):
        raise UsageError(f"{name} {'cannot be used' if offline else 'can only be used'} with --offline")
    if not 0.0 <= start < min(end, LONGEST_S) or (end > LONGEST_S and not math.isinf(end)):
        raise UsageError("--from and --to: give 0 <= --from < --to, in seconds")
    if offline:
        from fantwin.pipeline.cli.recordings.replay_offline import run_offline  # noqa: PLC0415  loads the stages
        from fantwin.pipeline.replay.offline.outcome import Again  # noqa: PLC0415

        again = Again(config, tuple(overrides or ()), twin, verify, start, end)
        run_offline(files, again, output, RecordingsInParallel(jobs, skip_bad), json_output=json_output)
        return
    pace = Pace(_rate(rate or "1"), paused=pause)
    keys = Keys()
    if pause and not keys.is_available:
        raise UsageError("--pause needs a terminal, to continue with a key")
    with local_copies():
        chosen = _chosen_topics(topics, from_topic)
        playback = RecordingPlayback(files, chosen, start, end)
        missing = _left_out(playback.files, chosen, is_asked_for=bool(topics or from_topic))
        replay_config = resolve_config(playback.files[0], playback.first, config, overrides or ())
        stop = stop_on_signals()
        reporter, end_s = Reporter(), playback.end_s()
        console = reporter.console
        if missing:
            console.print(missing, markup=False, soft_wrap=True)

        shown_s = 0.0

        def show_progress(progress: Progress) -> None:
            nonlocal shown_s
            if not console.is_terminal or (time.monotonic() - shown_s < _SHOWN_EVERY_S and not progress.paused):
                return
            shown_s = time.monotonic()
            at_s = playback.seconds_at(progress.t_ns)
            ends_s = 0 if progress.round else math.ceil(end_s)
            reporter.show("", int(at_s), ends_s, status_line(progress))

        with keys, reporter:
            outcome = publish(
                playback,
                pace,
                replay_config,
                stop,
                loop=loop,
                keys=keys.pressed,
                show=show_progress,
                report=lambda line: console.print(line, markup=False, soft_wrap=True),
            )
        for line in outcome.damage:
            console.print(line, markup=False, soft_wrap=True)
        for name in outcome.behind:
            console.print(f"{name} has not received all messages: see `fantwin status`", markup=False, soft_wrap=True)
    found = {"files": [str(file) for file in playback.files], **asdict(outcome)}
    show(found, _summary(outcome), json_output=json_output)
    if outcome.exit_code:
        raise typer.Exit(outcome.exit_code)


def _chosen_topics(topics: str | None, from_topic: str | None) -> tuple[str, ...]:
    if from_topic is not None:
        if topics is not None:
            raise UsageError("give --topics or --from-topic, not both")
        starts = replay_starts()
        if from_topic not in starts:
            raise UsageError(f"--from-topic {from_topic}: is not one of {', '.join(starts)}")
        return starts[from_topic]
    if topics is None:
        return REPLAYED
    chosen = tuple(topics.split(","))
    for name in chosen:
        if name not in REPLAYED:
            raise UsageError(f"--topics {name}: is not one of {', '.join(REPLAYED)}")
    return chosen


def _left_out(files: Sequence[Path], topics: Sequence[str], *, is_asked_for: bool) -> str:
    """A line about what the recorder left out of these topics; empty if nothing.

    Raises:
        UserError: the topics were asked for.
    """
    line = left_out_hint(files, topics)
    if line and is_asked_for:
        raise UserError(f"{files[0]}: {line}")
    return f"{files[0]}: {line}" if line else ""


def _rate(text: str) -> float:
    try:
        rate = math.inf if text == "max" else float(text)
    except ValueError:
        rate = math.nan
    if text != "max" and not 0.0 < rate <= LARGEST_RATE:
        raise UsageError(f"--rate {text}: give a number above 0, to {LARGEST_RATE:g}, or max")
    return rate


def status_line(progress: Progress) -> str:
    """One line: recorded time, rate, messages sent, keys."""
    rounds = f"  round {progress.round + 1}" if progress.round else ""
    rate = "as fast as possible" if math.isinf(progress.rate) else f"x {progress.rate:g}"
    state = "paused, " if progress.paused else ""
    return f"{format_utc(progress.t_ns)}{rounds}  {state}{rate}  {progress.messages:,} sent  ({_KEYS_HELP})"


def _summary(outcome: Outcome) -> str:
    messages = ", ".join(f"{count:,} {name}" for name, count in outcome.messages.items()) or "nothing"
    rate = f", {outcome.rate:.3g} times real time" if outcome.rate is not None else ""
    lost = ", ".join(f"{name} {count}" for name, count in outcome.lost.items()) or "nothing"
    ended = "stopped; " if outcome.stopped else ""
    return f"{ended}published {messages}: {outcome.recorded_s:.1f} s in {outcome.elapsed_s:.1f} s{rate}; lost: {lost}"
