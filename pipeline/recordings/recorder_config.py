"""The settings of the recorder, and which topics it records with them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pydantic import Field, field_validator

from pipeline.config.models import TrayConfig, nearest
from pipeline.runtime.stage import StageConfig
from schemas.topics import BY_NAME, TOPICS

MOST_FANS_RECORDED_WHOLE = 64
"""of a site, without `topics`: a larger site makes gigabytes an hour of what a replay makes again"""
FLUSH_S, FLEET_FLUSH_S = 1.0, 5.0
"""up to MOST_FANS_RECORDED_WHOLE fans, and above: at 1 Hz a chunk of one second holds nothing that repeats"""
RECORDED = tuple(topic.name for topic in TOPICS if topic.recorded)
SAMPLES = tuple(name for name in RECORDED if BY_NAME[name].has_samples)
"""the topics that may be left out"""
RAW = "raw"


class RecorderConfig(StageConfig):
    """Section `[recorder]`."""

    topics: tuple[str, ...] | None = Field(
        default=None,
        description=f"which topics of samples are recorded, of {', '.join(SAMPLES)}; all others always are. Without it "
        f"all of them up to {MOST_FANS_RECORDED_WHOLE} fans of the site, and {RAW} above that",
    )
    file: Path = Field(
        default=Path("recording.mcap"),
        description="relative to run_folder; its parts are NAME.mcap, NAME-2.mcap and so on, of a shard "
        "SHARD.NAME.mcap",
    )
    flush_interval_s: float | None = Field(
        default=None,
        gt=0,
        description=f"a crash loses at most this much; without it {FLUSH_S:g}, and {FLEET_FLUSH_S:g} where a recorder "
        f"has more than {MOST_FANS_RECORDED_WHOLE} fans",
    )
    part_bytes: int = Field(default=100_000_000, ge=0, description="a new part begins at this size; 0: never")
    part_s: float = Field(default=0.0, ge=0, description="a new part begins after this time; 0: never")
    min_free_bytes: int = Field(default=100_000_000, ge=0, description="free space to leave on the disk")
    delete_oldest: bool = Field(
        default=False, description="make room by deleting the oldest parts of this recording, instead of pausing"
    )

    clips: bool = Field(default=True, description="keep a clip of each alarm, in the folder clips beside the recording")
    clip_before_s: float = Field(default=60.0, ge=0, le=600, description="how long before the alarm a clip begins")
    clip_after_s: float = Field(default=60.0, ge=0, le=600, description="how long after the alarm a clip ends")
    clip_bytes: int = Field(
        default=1_000_000_000,
        ge=0,
        description="most space for all clips together; beyond it the oldest clips are deleted, but only those whose "
        "alarms are acknowledged; 0: no limit",
    )

    @field_validator("topics")
    @classmethod
    def _known(cls, value: tuple[str, ...] | None) -> tuple[str, ...] | None:
        for name in value or ():
            if name not in RECORDED:
                raise ValueError(f"unknown topic {name!r}{nearest(name, SAMPLES)}")
            if name not in SAMPLES:
                raise ValueError(f"{name} is always recorded: name only topics of samples, {', '.join(SAMPLES)}")
        return value

    @field_validator("part_bytes")
    @classmethod
    def _not_too_small(cls, value: int) -> int:
        if 0 < value < 1_000_000:
            raise ValueError("must be 0 (no limit) or at least 1,000,000 bytes")
        return value

    @field_validator("part_s")
    @classmethod
    def _not_too_short(cls, value: float) -> float:
        if 0 < value < 1.0:
            raise ValueError("must be 0 (no limit) or at least 1 s")
        return value


def recorded_topics(config: RecorderConfig, trays: Sequence[TrayConfig]) -> tuple[str, ...]:
    """The topics that are recorded of a site with these trays."""
    samples = config.topics
    if samples is None:
        samples = SAMPLES if sum(tray.fans for tray in trays) <= MOST_FANS_RECORDED_WHOLE else (RAW,)
    return tuple(name for name in RECORDED if name in samples or name not in SAMPLES)


def flush_interval_s(config: RecorderConfig, trays: Sequence[TrayConfig]) -> float:
    """How often a recorder that has these trays flushes to the disk."""
    if config.flush_interval_s is not None:
        return config.flush_interval_s
    return FLUSH_S if sum(tray.fans for tray in trays) <= MOST_FANS_RECORDED_WHOLE else FLEET_FLUSH_S
