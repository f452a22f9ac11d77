"""The configuration to replay a recording with: the one given, or the one that the recording contains.

A recording without one, such as an imported table, is replayed with defaults, at the rate of its twin.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from fantwin.pipeline.config.loading import load_config, parse_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.recordings.left_out import left_out_hint
from fantwin.pipeline.recordings.metadata import CONFIGURATION
from fantwin.pipeline.recordings.reading import RecordingError, RecordingMetadata, read_metadata, read_recording
from fantwin.pipeline.timebase.grid_timing import GAP_PERIODS
from fantwin.schemas.codec import CodecError
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.fan_names import is_fan_name
from fantwin.schemas.messages import Raw
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho
from fantwin.schemas.units import NS_PER_S

_SAMPLED = 500
"""samples of a tray from which the period is measured"""


def first_raw(paths: Sequence[Path], metadata: RecordingMetadata) -> dict[str, list[Raw]]:
    """The first raw messages of each tray, some hundred samples, without messages that have none.

    Raises:
        RecordingError: there are none.
    """
    found: dict[str, list[Raw]] = {}
    samples: dict[str, int] = {}
    for envelope in chain.from_iterable(read_recording(path, ("raw",)).undecoded() for path in paths):
        tray = envelope.key.split("/")[2]
        if samples.get(tray, 0) < _SAMPLED:
            try:
                message = envelope.message
            except CodecError:
                continue
            assert isinstance(message, Raw)
            if not len(message.host_receive_t_ns):
                continue
            found.setdefault(tray, []).append(message)
            samples[tray] = samples.get(tray, 0) + len(message.host_receive_t_ns)
        if metadata.trays and all(samples.get(name, 0) >= _SAMPLED for name in metadata.trays):
            break
    if not found:
        why = left_out_hint(paths, ("raw",)) or "there is nothing to score"
        raise RecordingError(f"{paths[0]}: no raw samples in this recording: {why}")
    return {tray: found[tray] for tray in sorted(found)}


def default_config(
    path: Path,
    metadata: RecordingMetadata,
    first: Mapping[str, Sequence[Raw]],
    twin: Path,
    overrides: Iterable[str],
    stages: Iterable[str],
) -> Config:
    """Defaults with the recording's trays, the twin's rate, and a gap limit from the recording's sample period.

    Raises:
        StageError: the twin cannot be used.
        ConfigError: `overrides` are not valid, or a tray is not.
    """
    rate_hz = rounded_rate_hz(load_tray_twin(twin, next(iter(first.values()))[0].fans).card.rate_hz)
    gap_limit_s = max(0.1, GAP_PERIODS * max(_period_s(messages) for messages in first.values()))
    text = (
        f"# defaults: there was no configuration\nsite = {json.dumps(metadata.metadata.get('site', 'site'))}\n\n"
        f"[resampler]\nrate_hz = {rate_hz}\ngap_limit_s = {gap_limit_s}\n"
    )
    for tray, messages in first.items():
        unit = metadata.speed_unit(tray) if metadata.speed_unit(tray) in ("rad/s", "rpm") else "rad/s"
        names = metadata.names(tray).names
        is_named = len({*names}) == messages[0].fans and all(map(is_fan_name, names))
        fans = json.dumps(names, ensure_ascii=False) if is_named else messages[0].fans
        text += f'\n[[tray]]\nname = {json.dumps(tray)}\nfans = {fans}\nspeed_unit = "{unit}"\n'
        if (tacho := metadata.tacho(tray, messages[0].tachos)) != INSTANTANEOUS:
            text += f"tacho = [{', '.join(_toml_table(its) for its in tacho)}]\n"
    return parse_config(text, path, overrides, stages)


def rounded_rate_hz(rate_hz: float) -> float:
    """The rate of a grid for a twin that was trained at this one."""
    return float(f"{rate_hz:.3g}")


def _toml_table(tacho: Tacho) -> str:
    # Numbers and simple texts are written alike in JSON and in TOML.
    items = (f"{key} = {json.dumps(value)}" for key, value in tacho.model_dump(exclude_defaults=True).items())
    return f"{{ {', '.join(items)} }}"


def _period_s(messages: Sequence[Raw]) -> float:
    periods_ns = np.diff(np.concatenate([message.host_receive_t_ns for message in messages]))
    periods_ns = periods_ns[periods_ns > 0]
    return float(np.median(periods_ns)) / NS_PER_S if len(periods_ns) else 0.0


def resolve_config(file: Path, first: Envelope, config: Path | None, overrides: Iterable[str]) -> Config:
    """The configuration for a live replay: `config`, else the one attached to `file`, else defaults with the site and
    trays of the recording. `first` is the recording's first message.

    Raises:
        ConfigError: it cannot be used.
        RecordingError: the file cannot be read.
    """
    if config is not None:
        return load_config(config, overrides, stages=())
    metadata = read_metadata(file)
    if CONFIGURATION in metadata.attachments:
        # the bus of the recorded run was set on its command line; today's stages use the file's or the default
        recorded = [override for override in _recorded_overrides(file, metadata) if not override.startswith("bus.")]
        return _parsed(file, metadata, [*recorded, *overrides], stages=())
    _, site, tray, *_ = first.key.split("/")
    trays = metadata.metadata.get("trays") or tray
    # a live replay does not use `fans`
    sections = [f"[[tray]]\nname = {json.dumps(name)}\nfans = 1\n" for name in trays.split(",")]
    return parse_config(f"site = {json.dumps(site)}\n{''.join(sections)}", file, overrides, stages=())


def attached_config(
    file: Path, metadata: RecordingMetadata, stages: Iterable[str], overrides: Iterable[str] = ()
) -> Config | None:
    """The recorded configuration with `overrides` on top; None where there is none. Only the sections of `stages` are
    checked.

    Raises:
        ConfigError: it is not valid, as after an update.
        RecordingError: its recorded overrides cannot be read.
    """
    if CONFIGURATION not in metadata.attachments:
        return None
    return _parsed(file, metadata, [*_recorded_overrides(file, metadata), *overrides], stages)


def _parsed(file: Path, metadata: RecordingMetadata, overrides: Iterable[str], stages: Iterable[str]) -> Config:
    text = metadata.attachments[CONFIGURATION].decode(errors="replace")
    return parse_config(text, Path(f"{file}:{CONFIGURATION}"), overrides, stages)


def _recorded_overrides(file: Path, metadata: RecordingMetadata) -> list[str]:
    try:
        return [str(override) for override in json.loads(metadata.metadata.get("overrides", "[]"))]
    except (ValueError, TypeError) as error:
        raise RecordingError(f"{file}: its metadata are damaged: overrides are not a list") from error


def trays_of(files: Iterable[Path]) -> set[str]:
    """The trays in the metadata of recordings."""
    return {tray for file in files for tray in read_metadata(file).trays}
