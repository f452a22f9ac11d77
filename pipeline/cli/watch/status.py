"""`fantwin status`: stages, rates, losses and alarms; live on a terminal, printed once elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from typing import Annotated

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from fantwin.pipeline.bus.session import Bus, join_bus
from fantwin.pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from fantwin.pipeline.cli.printing import STYLES, duration_text, show, table_of
from fantwin.pipeline.cli.watch.commission_state import RECORDING_ONLY, commissioning_now
from fantwin.pipeline.cli.watch.wear import show_wear_of_site
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.roles import READERS, role_names, roles_of
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.config.shards import StageProcess, chosen_shard, process_list
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.launch.this_host import load_for_any_host
from fantwin.pipeline.runtime.signals import stop_on_signals
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.judging import Unjudged, as_judged, at_rest, unjudged
from fantwin.pipeline.site.loss_accounting import refused_lines
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.site.stage_states import AT_WORK, StageState, StageView, Word, note_lines, notes_as_json
from fantwin.schemas.streams import LOSS_PREFIX
from fantwin.schemas.topics import ALL_TRAYS
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import is_listed, is_presented
from fantwin.scoring.alarms.current_alarms import CurrentAlarm, clock
from fantwin.scoring.diagnosis.causes import most_probable

_LISTEN_S = 2.5  # two health messages of every stage, which give rates
_LISTEN_MAX_S = 6.0
_POLL_S = 0.2
_STATE_STYLES = {Word.OK: "green", Word.DEGRADED: "red"}


def status(
    config: ConfigOption = DEFAULT_CONFIG,
    once: Annotated[bool, typer.Option("--once", help="Print once and exit, on a terminal too.")] = False,
    stage: Annotated[
        str | None, typer.Option(help="Only whether this one process is at work: for a probe, with --trays or --shard.")
    ] = None,
    trays: Annotated[str | None, typer.Option(metavar="A,B", help="With --stage: the trays of the process.")] = None,
    shard: Annotated[str | None, typer.Option(metavar="K/N", help="With --stage: the shard of the process.")] = None,
    wear: Annotated[
        bool, typer.Option("--wear", help="Only how each fan has changed since commissioning, and how fast.")
    ] = False,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """Show stages, rates, latency, losses and alarms of a running site.

    Each stage that the configuration asks for has a row. A stage that needs an extra has a row only if it was heard, or
    if `launcher.stages` names it. Stays live on a terminal, until Ctrl-C. Into a pipe or a file it prints once and
    exits. Losses count from the start of a stage (column `up`: how long ago), over all sessions heard while this
    command runs; `fantwin up` at its end and `fantwin info` count all sessions.

    Below the table are the counters of what was lost and refused; --json has all counters.

    While `fantwin commission` runs on this host, only the stages that record are expected.

    Exit code 1 if a stage is missing, gone, silent, starved or late or has a problem, such as a recorder that cannot
    write, or if a fan is not judged though the configuration has a scorer; 3 if a stage has lost data.

    With --stage: 0 if that process is heard and has caught up, 1 if not, whatever the others do.

    With --wear: 0 if shown, 1 if nothing is known yet (docs/explanation/wear.md).

    Example: fantwin status -c fantwin.toml --once

    Example: fantwin status -c fantwin.toml --stage scorer --shard 2/8
    """
    settings = load_for_any_host(config, overrides or (), stages=())
    if wear:
        show_wear_of_site(settings, json_output=json_output)
        return
    stop = stop_on_signals()
    if stage is not None:
        if stage not in STAGES:
            raise UsageError(f"--stage {stage}: no such stage; known: {', '.join(STAGES)}")
        process = StageProcess(stage, chosen_shard(stage, settings, trays, shard))
        _probe(settings, process, stop, json_output=json_output)
        return
    if trays or shard:
        raise UsageError("--trays and --shard need --stage: which process?")
    recording = load_for_any_host(config, [*(overrides or ()), *RECORDING_ONLY[1::2]], stages=())

    def expected() -> tuple[Config, str]:
        """What should run now, and what a commissioning does."""
        doing = commissioning_now(settings.run_folder)
        return recording if doing else settings, doing

    with join_bus(settings, listens=False) as bus:
        of_bus = _bus_lines(bus)
        watcher = SiteWatcher(bus, settings.site, roles_of(settings), settings.trays, has_scores=True)
        if once or json_output or not sys.stdout.isatty():
            wanted, doing = expected()
            _listen(watcher, wanted, stop)
            watcher.ask_for_past_alarms()
            _require_a_stage(watcher, wanted, doing)
            found = as_json(watcher, wanted, doing) if json_output else {}
            show(found, stage_table(watcher, wanted, of_bus, doing), json_output=json_output)
        else:
            watcher.ask_for_past_alarms()
            with Live(console=Console(), refresh_per_second=4) as live:
                while not stop.wait(0.25):
                    wanted, doing = expected()
                    live.update(stage_table(watcher, wanted, of_bus, doing))
            wanted, doing = expected()
            _require_a_stage(watcher, wanted, doing)
        states = [] if doing and not watcher.alive() else watcher.states(process_list(wanted))
        if any(state.is_fault or state.problem for state in states) or not_judged(states, watcher.model):
            raise typer.Exit(1)
        if any(watcher.losses().values()):
            raise typer.Exit(3)


def _probe(config: Config, process: StageProcess, stop: threading.Event, *, json_output: bool) -> None:
    """Say whether one process is at work: as soon as it is known, or when it has not been heard for long enough."""
    with join_bus(config, listens=False, roles=(*READERS, *role_names(process.stage, process.shard))) as bus:
        watcher = SiteWatcher(bus, config.site, roles_of(config))
        until_s = time.monotonic() + _LISTEN_MAX_S
        while True:
            watcher.ask_for_health(process.stage, process.instance)
            states = (each for each in watcher.states([process]) if each.label == process.label)
            state = next(states, None) or StageState(process.label, Word.MISSING, "not seen on the bus", None, True)
            is_at_work = state.word in AT_WORK - {Word.STARTING} and state.view is not None and state.view.alive
            if is_at_work or time.monotonic() > until_s or stop.wait(_POLL_S):
                break
    problem = state.view.health.problem if state.view else ""
    line = f"{state.label}: {state.word}{''.join(f': {each}' for each in (state.detail, problem) if each)}"
    show(_state_as_json(state, state.view.health.lost if state.view else 0), line, json_output=json_output)
    if not is_at_work:
        raise typer.Exit(1)


def _listen(watcher: SiteWatcher, config: Config, stop: threading.Event) -> None:
    """Long enough for rates; longer as long as something seems to be missing, which may not be discovered yet."""
    began_s = time.monotonic()
    while not stop.wait(0.1) and time.monotonic() < began_s + _LISTEN_MAX_S:
        states = watcher.states(process_list(config))
        is_complete = not any(state.is_fault for state in states) and not not_judged(states, watcher.model)
        if is_complete and time.monotonic() > began_s + _LISTEN_S:
            return


def _require_a_stage(watcher: SiteWatcher, config: Config, doing: str) -> None:
    """doing: what a commissioning does, which at times runs no stage."""
    if not watcher.stages() and not doing:
        raise UserError(f"{_no_stage(config)}; is `fantwin up -c {config.path}` running?")


def _no_stage(config: Config) -> str:
    return f"no stage of site {config.site!r} answers at {config.bus.endpoint}"


def _bus_lines(bus: Bus) -> list[Text]:
    """Which certificate this command shows, and what is wrong with it."""
    if bus.credentials is None:
        return []
    own = bus.credentials.own
    line = Text(f"certificate of this command: {own.role}, until {own.not_after:%Y-%m-%d}", style="dim")
    return [line, *(Text(each, style="red") for each in [bus.certificate_warning()] if each)]


def stage_table(watcher: SiteWatcher, config: Config, of_bus: Sequence[Text] = (), doing: str = "") -> Group:
    """The page for people: a row for each stage, then problems, then alarms, then the fans that are not judged.

    of_bus: lines on the bus itself. doing: what a commissioning does.
    """
    if doing and not watcher.alive():
        return Group(*of_bus, _commissioning(doing))
    columns = ("up", "in /s", "out /s", "p50 ms", "p99 ms", "lost")
    table = table_of(("stage", "state"), columns, title="stages")
    lost = watcher.losses()
    states = watcher.states(process_list(config))
    # a name that is cut may be any stage's
    table.columns[0].min_width = max((len(state.label) for state in states), default=0)
    is_anyone_there = any(state.view and state.view.alive for state in states)
    problems = [] if is_anyone_there else [Text(_no_stage(config), style="red")]
    for state in states:
        style = "red" if state.is_fault else _STATE_STYLES.get(state.word, "yellow")
        table.add_row(state.label, Text(state.word, style=style), *_figures(state.view, lost.get(state.label, 0)))
        if state.detail and (state.is_fault or state.word == Word.WAITING):
            problems.append(Text(f"{state.label}: {state.detail}", style=style))
        if state.problem:
            problems.append(Text(f"{state.label}: {state.problem}", style="red"))
    notes = [Text(line) for line in note_lines(state.view.health for state in states if state.view)]
    problems += [Text(line, style="yellow") for line in (*loss_lines(states), *refused_lines(watcher.refused()))]
    lacking = not_judged(states, watcher.model)
    current = [each for each in as_judged(watcher.current_alarms(), lacking) if is_listed(each.newest)]
    words_now = watcher.model.words_now([Fan(each.newest.header.tray, each.newest.fan) for each in current])
    alarms = [_alarm_line(each, now) for each, now in zip(current, words_now, strict=True)]
    if doing:
        missing = [_commissioning(doing)]
    elif not _has_scorer(states):
        missing = [Text("no fan is judged: the configuration has no scorer", style="yellow")]
    elif not any(state.view and state.view.alive and state.view.health.stage == "scorer" for state in states):
        missing = [Text("alarms unknown: no scorer is alive", style="red")]
    else:
        missing = [Text(each.line(), style="red") for each in lacking]
    resting = [Text(each.line(), style="dim") for each in at_rest(watcher.model)]
    no_alarms = [] if alarms or missing else [Text("no alarms", style="green")]
    return Group(
        *([table] if watcher.stages() else []), *of_bus, *notes, *problems, *alarms, *missing, *resting, *no_alarms
    )


def _commissioning(doing: str) -> Text:
    return Text(f"commissioning: {doing}; no fan is judged before `fantwin up`", style="yellow")


def _has_scorer(states: Sequence[StageState]) -> bool:
    """Whether the configuration asks for a scorer, or one is heard."""
    return any(state.stage == "scorer" for state in states)


def not_judged(states: Sequence[StageState], model: SiteModel) -> list[Unjudged]:
    """The fans that should be judged and are not."""
    return unjudged(model, states) if _has_scorer(states) else []


def loss_lines(states: Sequence[StageState]) -> list[str]:
    """What the sessions that run have lost, by counter and input."""
    lines: list[str] = []
    for state in states:
        if state.view and state.view.health.lost:
            health = state.view.health
            counts = [(each.name, each.value) for each in health.counters if each.name.startswith(LOSS_PREFIX)]
            missing = [(f"missing on {'/'.join(each.key.split('/')[2:])}", each.missing) for each in health.inputs]
            found = ", ".join(f"{name} {count}" for name, count in (*counts, *missing) if count)
            lines.append(f"{state.label}: lost since its start: {found}")
    return lines


def _figures(view: StageView | None, lost: int) -> list[str | Text]:
    """How long it has run, rates, latencies and losses; empty for a stage that was not heard."""
    if view is None:
        return []
    health = view.health
    latency = (f"{health.latency_p50_ms:.1f}", f"{health.latency_p99_ms:.1f}") if health.latency_p99_ms else ("", "")
    rates = (f"{view.rate_in_hz:.0f}", f"{view.rate_out_hz:.0f}")
    return [duration_text(health.uptime_s), *rates, *latency, Text(str(lost), style="red" if lost else "")]


def _alarm_line(current: CurrentAlarm, now: str) -> Text:
    alarm = current.newest
    style = STYLES.get(alarm.severity, "bold red") if alarm.active else "green"
    text = Text.assemble(
        (f"{clock(alarm.t_ns)}  {alarm.severity.name:7}", style if is_presented(alarm) else "dim"),
        f"  {alarm.header.tray}  {alarm.label}: {', '.join(current.states())}",
    )
    about = current.about()
    if now:
        text.append(f", now {now}")
    text.append("".join(f", {cause}" for cause in most_probable(current.causes)))
    return text.append(f"; {about}") if about else text


def as_json(watcher: SiteWatcher, config: Config, doing: str = "") -> dict[str, object]:
    """The same for machines (`--json`)."""
    states, lost = watcher.states(process_list(config)), watcher.losses()
    lacking = not_judged(states, watcher.model)
    return {
        "commissioning": doing,
        "stages": [_state_as_json(state, lost.get(state.label, 0)) for state in states],
        "alarms": [current.as_json() for current in as_judged(watcher.current_alarms(), lacking)],
        "not_judged": [each.as_json() for each in lacking],
        "at_rest": [each.as_json() for each in at_rest(watcher.model)],
    }


def _state_as_json(state: StageState, lost: int) -> dict[str, object]:
    stage, _, instance = state.label.partition("/")
    about = {
        "stage": stage,
        "instance": instance or ALL_TRAYS,
        "trays": list(state.trays),
        "state": str(state.word),
        "detail": state.detail,
    }
    view = state.view
    if view is None:
        return {**about, "alive": False}
    health = view.health
    ages_s = {"input_age_s": health.newest_input_t_ns, "output_age_s": health.newest_output_t_ns}
    return {
        **about,
        "alive": view.alive,
        "status": health.status.name.lower(),
        "problem": health.problem,
        "notes": notes_as_json(health),
        "process_id": health.process_id,
        "rate_in_hz": round(view.rate_in_hz, 1),
        "rate_out_hz": round(view.rate_out_hz, 1),
        "latency_ms": {"p50": health.latency_p50_ms, "p99": health.latency_p99_ms},
        "waiting_for": [each.key for each in health.waiting_for],
        **{name: round((health.t_ns - t_ns) / NS_PER_S, 3) if t_ns else None for name, t_ns in ages_s.items()},
        "uptime_s": round(health.uptime_s, 3),
        "lost": lost,
        "counters": {counter.name: counter.value for counter in health.counters},
    }
