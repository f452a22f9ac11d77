"""The configuration of a recording that has none, such as an imported table: defaults, at the rate of its twin."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from pipeline.config.loading import parse_config
from pipeline.config.models import Config
from pipeline.recordings.reading import RecordingError, RecordingMetadata, read_recording
from pipeline.runtime.tray_twin import load_tray_twin
from schemas.codec import CodecError
from schemas.messages import Raw

GAP_STEPS = 5.0
"""of the recording's own samples: so many may be bridged"""
_LOOKED_AT = 500
"""samples of a tray, to know how far they are apart"""


def first_raw(paths: Sequence[Path], head: RecordingMetadata) -> dict[str, list[Raw]]:
    """The first raw messages of each tray, some hundred samples of it.

    Raises:
        RecordingError: there are none.
    """
    told = [name for name in head.metadata.get("trays", "").split(",") if name]
    found: dict[str, list[Raw]] = {}
    samples: dict[str, int] = {}
    for packet in chain.from_iterable(read_recording(path, ("raw",)).undecoded() for path in paths):
        tray = packet.key.split("/")[2]
        if samples.get(tray, 0) < _LOOKED_AT:
            try:
                message = packet.message
            except CodecError:
                continue
            assert isinstance(message, Raw)
            found.setdefault(tray, []).append(message)
            samples[tray] = samples.get(tray, 0) + len(message.host_receive_t_ns)
        if told and all(samples.get(name, 0) >= _LOOKED_AT for name in told):
            break
    if not found:
        raise RecordingError(f"{paths[0]}: no raw samples in this recording: there is nothing to judge")
    return {tray: found[tray] for tray in sorted(found)}


def default_config(
    path: Path,
    head: RecordingMetadata,
    first: Mapping[str, Sequence[Raw]],
    twin: Path,
    overrides: Iterable[str],
    stages: Iterable[str],
) -> Config:
    """Defaults, with the trays of the recording, the twin's rate, and gaps measured by the recording's own samples.

    Raises:
        StageError: the twin cannot be used.
        ConfigError: `overrides` are wrong, or a tray cannot be described.
    """
    rate_hz = float(f"{load_tray_twin(twin, next(iter(first.values()))[0].fans).card.rate_hz:.3g}")
    gap_limit_s = max(0.1, GAP_STEPS * max(_step_s(messages) for messages in first.values()))
    text = (
        f"# made up: the recording has no configuration\nsite = {json.dumps(head.metadata.get('site', 'site'))}\n\n"
        f"[resampler]\nrate_hz = {rate_hz}\ngap_limit_s = {gap_limit_s}\n"
        f"watermark_s = {max(0.5, gap_limit_s)}\nstale_for_s = {max(5.0, gap_limit_s)}\n"
    )
    for tray, messages in first.items():
        unit = head.speed_unit(tray) if head.speed_unit(tray) in ("rad/s", "rpm") else "rad/s"
        text += f'\n[[tray]]\nname = {json.dumps(tray)}\nfans = {messages[0].fans}\nspeed_unit = "{unit}"\n'
    return parse_config(text, path, overrides, stages)


def _step_s(messages: Sequence[Raw]) -> float:
    steps_ns = np.diff(np.concatenate([message.host_receive_t_ns for message in messages]))
    steps_ns = steps_ns[steps_ns > 0]
    return float(np.median(steps_ns)) / 1e9 if len(steps_ns) else 0.0
