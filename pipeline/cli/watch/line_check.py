"""Listens to the line of one tray and says what does not fit its configuration: rate, range, fans, unit, tachos.

Acquisition's own core reads the source, so that the samples are those that a running site would get. If acquisition
runs already, its samples are taken from the bus instead. The samples of a tray whose clients push them are on the bus
only: they are listened to while acquisition runs, as clients need it to begin.
"""

from __future__ import annotations

import json
import queue
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from fantwin.pipeline.acquisition.raw_samples import RawSamples
from fantwin.pipeline.acquisition.sample_blocks import SampleBlocks
from fantwin.pipeline.bus.session import join_bus
from fantwin.pipeline.config.settings import Config, TrayConfig
from fantwin.pipeline.prediction.tray_twin import TrayTwin, load_tray_twin, twin_path
from fantwin.pipeline.runtime.stage import Context, StageError, load_stage
from fantwin.pipeline.sources.polling import Doubt, PollingSource
from fantwin.pipeline.sources.tacho_evidence import find_tacho, tacho_hints
from fantwin.pipeline.timebase.device_clock import UINT32
from fantwin.pipeline.timebase.grid_timing import GridTiming, grid_rate_hz, is_too_slow, leaves_gaps
from fantwin.pipeline.timebase.line_rate import MAX_SAMPLES, SampleTimes
from fantwin.schemas.messages import Array, Raw
from fantwin.schemas.units import NS_PER_S, RAD_S_PER_UNIT, SpeedUnit, period_in_words
from fantwin.schemas.wire import DEVICE_COUNTERS

FIRST_SAMPLE_S = 6.0
"""a microcontroller restarts when its port is opened, and sends its first sample after some seconds"""
FASTEST_FAN_RAD_S = 5000.0
"""48,000 rpm: a larger speed was given in another unit"""
NO_SPEED_RAD_S = 0.05
RATE_TOLERANCE = 0.01
MOST_RANGES = 8
"""lines with commands and speeds; where fans differ more, one has them all"""
LISTEN_FOR_TACHOS_S = 60
LISTENED_ENOUGH = 0.9
PUSHED_LATER = "clients push its samples: they are checked only while `fantwin up` runs; run doctor again then"
_KEYS = ("name", "place")
Finding = tuple[bool | None, str]
"""in order, not in order, or (None) to be looked at, and one line"""


def check_line(context: Context, config: Config, seconds: float, *, is_running: bool) -> list[Finding]:
    """Listen to the tray's line for some seconds after its first sample.

    context: of acquisition and one tray. is_running: acquisition runs already.
    """
    tray = context.tray
    if tray.source.takes_pushed and not is_running:
        return [(True, f"{tray.name}: {PUSHED_LATER}")]
    heard = _Heard(_from_bus(config, tray, seconds)) if is_running else _from_source(context, seconds)
    samples, problem, called, doubts = heard
    found: list[Finding] = [(False, f"{tray.name}: {problem}")] if problem else []
    if not samples:
        return found or [(False, f"{tray.name}: no sample in {FIRST_SAMPLE_S:g} s")]
    twin = None
    if tray.twin is not None:
        with suppress(StageError):  # the twin integrator reports it
            twin = load_tray_twin(twin_path(tray, context.folder), tray.fans)
    if any(name for name, _ in called) and not any(tray.names.names):
        found.append((True, f"{tray.name}: its device names the fans: to show these, write {_as_toml(called)}"))
    return [*found, *((ok, f"{tray.name}: {line}") for ok, line in _findings(samples, tray, config, twin, doubts))]


def _as_toml(called: Sequence[tuple[str, str]]) -> str:
    """Fans with names and places, in the place of `fans`."""
    fans = (
        ", ".join(
            f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in zip(_KEYS, fan, strict=True) if value
        )
        for fan in called
    )
    return f"fan = [{', '.join(f'{{ {each} }}' for each in fans)}]"


class _Heard(NamedTuple):
    """The samples that acquisition would publish, what it would report as its problem, what the device calls the fans
    and their places, and its doubts of what it reads."""

    samples: list[Raw]
    problem: str = ""
    called: Sequence[tuple[str, str]] = ()
    doubts: Mapping[int, Doubt] = {}


def _from_source(context: Context, seconds: float) -> _Heard:
    settings = context.config.model_copy(update={"block_s": 0.0})
    built = load_stage("acquisition").build(Context(**(vars(context) | {"config": settings})))
    core, source = built.core, built.source
    assert source is not None
    items: queue.SimpleQueue[Any] = queue.SimpleQueue()
    samples: list[Raw] = []
    source.start(items.put)
    try:
        until_s = time.monotonic() + FIRST_SAMPLE_S
        while (left_s := until_s - time.monotonic()) > 0:
            with suppress(queue.Empty):
                found = core.step(items.get(timeout=min(left_s, 0.05)))
                if found and not samples:
                    until_s = time.monotonic() + seconds
                samples += [message for message in found if isinstance(message, Raw)]
            core.tick(time.time_ns())
    finally:
        source.stop()
    problem = core.problem().replace("; waiting for it", "")  # the doctor does not
    if not samples:  # what was refused is the reason, also where the source is asked so rarely that it seems silent
        problem = "; ".join(dict.fromkeys(filter(None, (problem, *core.notes()))))
    device = source.source if isinstance(source, SampleBlocks) else source
    if not isinstance(device, PollingSource):
        return _Heard(samples, problem or refusal(core.counters()))
    tray = context.tray
    doubts = device.doubts(tray.speed_max * RAD_S_PER_UNIT[tray.speed_unit] / RAD_S_PER_UNIT["rpm"])
    if not any(doubt.remedy for doubt in doubts.values()):  # which says it better
        problem = problem or refusal(core.counters())
    return _Heard(samples, problem, device.fans_called, doubts)


def refusal(counters: Mapping[str, int]) -> str:
    """What of the input was refused, in one line; empty if nothing was, or only what disturbances of a line explain.

    counters: of acquisition.
    """
    refused = counters.get("refused_input", 0)
    of_setting = any(counters.get(name) for name in _OF_A_SETTING)
    if not of_setting and refused <= max(1, _DISTURBED_SHARE * counters.get("samples", 0)):
        return ""
    if not refused:
        beyond = f"{counters['absurd_speed']} speeds are beyond speed_max and count as missing"
        return f"{beyond}: correct speed_max, speed_unit, or which number the source reads"
    named = ", ".join(f"{name} {n}" for name, n in counters.items() if n and name not in _NOT_NAMED)
    return f"{refused} of the inputs cannot be used: {named}; see docs/reference/wire-protocol.md"


_OF_THE_DEVICE = {f"device_{name}" for name in DEVICE_COUNTERS}
_NOT_NAMED = {"bytes", "samples", "line_up", "line_down", "no_speed", "refused_input", "unknown_type", *_OF_THE_DEVICE}
_OF_A_SETTING = ("absurd_command", "absurd_speed")
_DISTURBED_SHARE = 0.01
"""of the samples: so many lines may be cut or garbled"""


def _from_bus(config: Config, tray: TrayConfig, seconds: float) -> list[Raw]:
    with join_bus(config, listens=False) as bus:
        arriving = RawSamples(bus, config.site, [tray.name])
        first = arriving.take(FIRST_SAMPLE_S)
        if first:
            time.sleep(seconds)
        return [*first, *arriving.take()]


def _findings(
    samples: Sequence[Raw], tray: TrayConfig, config: Config, twin: TrayTwin | None, doubts: Mapping[int, Doubt]
) -> Iterator[Finding]:
    """doubts: of the device, by fan."""
    fitting = [sample for sample in samples if sample.fans == tray.fans]
    if not fitting:
        yield False, f"samples of {samples[0].fans} fans, [[tray]] says fans = {tray.fans}: correct one of them"
        return
    times = SampleTimes(MAX_SAMPLES)
    for sample in fitting:
        times.add(sample)
    yield _rate(times, config, twin)
    command = np.concatenate([sample.command for sample in fitting])
    speed_rad_s = np.concatenate([sample.speed_rad_s for sample in fitting])
    yield from _ranges(command, speed_rad_s, tray, twin, doubts)
    times_us = np.concatenate([times.times_of(sample) for sample in fitting])
    steps_us = (np.diff(times_us, prepend=times_us[:1]) + UINT32 // 2) % UINT32 - UINT32 // 2  # a clock may wrap
    yield from _tachos(np.cumsum(steps_us) / 1e6, speed_rad_s, tray)


def _rate(times: SampleTimes, config: Config, twin: TrayTwin | None) -> Finding:
    """Whether the rate of the line fits the resampler and the twin."""
    if times.span_us == 0 or not np.isfinite(times.line_hz):
        return True, "one sample: the rate of the line is not known yet; --listen-s 10 listens for longer"
    line_hz = times.line_hz
    apart = f"{line_hz:.3g} samples a second" if line_hz >= 1.0 else f"a sample every {period_in_words(1.0 / line_hz)}"
    settings: Any = config.sections.get("resampler")
    if settings is None:
        return True, apart
    if settings.rate_hz is None and is_too_slow(line_hz):
        return False, f"{apart}: too slow to be judged; let the device send one a minute"
    timing: GridTiming = settings.timing(settings.rate_hz or grid_rate_hz(times.sent_hz))
    if leaves_gaps(line_hz, timing):
        limit = f"resampler.gap_limit_s = {timing.gap_limit_ns / NS_PER_S:g}"
        return False, f"{apart}, too few for {limit}: leave out rate_hz and gap_limit_s, they follow from the line"
    if twin and twin.card.fixed_rate and abs(timing.rate_hz / twin.card.rate_hz - 1) > RATE_TOLERANCE:
        return False, (
            f"{apart}: a grid of {timing.rate_hz:g} Hz, and twin {twin.card.name} is valid at "
            f"{twin.card.rate_hz:.4g} Hz only: set resampler.rate_hz = {twin.card.rate_hz:.3g}"
        )
    return True, f"{apart}: grid of {timing.rate_hz:.3g} Hz, gaps are longer than {timing.gap_limit_ns / NS_PER_S:g} s"


def _ranges(
    command: Array, speed_rad_s: Array, tray: TrayConfig, twin: TrayTwin | None, doubts: Mapping[int, Doubt]
) -> Iterator[Finding]:
    """Commands and speeds. command, speed_rad_s: (n, fans)."""
    per_unit = RAD_S_PER_UNIT[tray.speed_unit]
    for fan, doubt in doubts.items():
        if doubt.remedy:
            yield False, f"{tray.label(fan)}: {doubt.read}: {doubt.remedy}"
    misread = {fan for fan, doubt in doubts.items() if doubt.remedy}
    silent = set(np.flatnonzero(~np.isfinite(speed_rad_s).any(axis=0)).tolist()) - misread
    for fan in sorted(silent & doubts.keys()):
        yield False, f"no speed of {tray.label(fan)}: {doubts[fan].read}"
    if unknown := sorted(silent - doubts.keys()):
        yield False, f"no speed of {tray.names.labels(unknown)}: {tray.source.no_speed}"
    known_commands = command[np.isfinite(command)]  # a fan's may be unknown, but not all
    if without := np.flatnonzero(~np.isfinite(command).any(axis=0)).tolist():
        where = "say in source where it is, or write command_from"
        yield None, f"{tray.names.labels(without)}: no command is known, so not judged: {where}"
    low, high = float(known_commands.min()), float(known_commands.max())
    if twin and not (twin.card.command_range[0] <= high and low <= twin.card.command_range[1]):
        known = "{:g} to {:g}".format(*twin.card.command_range)
        yield False, f"commands {low:g} to {high:g}, and the twin knows {known}: do device and twin have one unit?"
    shown = [fan for fan in range(tray.fans) if fan not in silent | misread]
    if not shown:
        return
    fastest_rad_s = float(np.nanmax(np.abs(speed_rad_s[:, shown])))
    limit_rad_s = min(FASTEST_FAN_RAD_S, 3.0 * twin.card.top_speed_rad_s if twin else FASTEST_FAN_RAD_S)
    if fastest_rad_s > limit_rad_s:
        other = "rpm" if tray.speed_unit == "rad/s" else "rad/s"
        known = f"; the twin knows {twin.card.top_speed_rad_s / per_unit:.0f}" if twin else ""
        yield False, f'speeds up to {fastest_rad_s / per_unit:.0f} {tray.speed_unit}{known}: is speed_unit "{other}"?'
        return
    is_still = np.nanmax(np.abs(np.nan_to_num(speed_rad_s)), axis=0) < NO_SPEED_RAD_S
    for fan in [each for each in shown if is_still[each] and command[:, each].min() > max(tray.command_min, 0.0)]:
        shown.remove(fan)
        where = f" ({doubts[fan].read})" if fan in doubts else ""
        yield None, f"{tray.label(fan)} reads 0 at command {command[-1, fan]:g}: does it turn?{where}"
    lines: dict[str, list[int]] = {}
    for fan in shown:
        lines.setdefault(_range_of(command[:, [fan]], speed_rad_s[:, [fan]], tray), []).append(fan)
    if len(lines) > MOST_RANGES and shown:
        lines = {_range_of(command[:, shown], speed_rad_s[:, shown], tray): shown}
    for line, fans in lines.items():
        yield True, f"{tray.names.labels(fans)}: {line}: is this so?"


def _range_of(command: Array, speed_rad_s: Array, tray: TrayConfig) -> str:
    """Commands and speeds of some fans in words. command, speed_rad_s: (n, fans)."""
    speeds = _speeds(speed_rad_s, tray.speed_unit)
    if tray.speed_unit == "rad/s":  # numbers in rpm that are taken for rad/s are plausible, and ten times too large
        speeds += f" ({_speeds(speed_rad_s, 'rpm')})"
    limits = f"of {tray.command_min:g} to {tray.command_max:g}"
    known = command[np.isfinite(command)]
    commands = f"commands {known.min():g} to {known.max():g} ({limits}), " if len(known) else ""
    return f"{commands}speeds {speeds}"


def _tachos(t_s: Array, speed_rad_s: Array, tray: TrayConfig) -> Iterator[Finding]:
    """Whether the readings are those of the declared tachos. t_s: (n,). speed_rad_s: (n, fans)."""
    hints = tacho_hints(t_s, speed_rad_s, tray.tachos, range(tray.fans), tray.names)
    for hint in hints:
        yield False, hint
    seen = np.array([find_tacho(t_s, readings) is not None for readings in speed_rad_s.T])
    if seen.any() and not hints:
        yield True, f"tachos of {tray.names.labels(np.flatnonzero(seen).tolist())}: they read as declared"
    if not seen.all() and (hints or (tray.tacho is None and not tray.stated_tachos)):
        unseen = f"{tray.names.labels(np.flatnonzero(~seen).tolist())}: not shown whether the tacho counts or holds"
        how = f"listen while the speeds change: --listen-s {LISTEN_FOR_TACHOS_S}"
        if t_s[-1] - t_s[0] > LISTENED_ENOUGH * LISTEN_FOR_TACHOS_S:
            how = "write `tacho` in [[tray]] if its manual says so; `fantwin commission` looks again"
        yield True, f"{unseen}; {how}"


def _speeds(speed_rad_s: Array, unit: SpeedUnit) -> str:
    slowest, fastest = (float(of(speed_rad_s)) / RAD_S_PER_UNIT[unit] for of in (np.nanmin, np.nanmax))
    return f"{round(slowest)} to {round(fastest)} {unit}"
