"""The settings of the recorder, and which topics it records with them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pydantic import Field, field_validator

from pipeline.config.models import TrayConfig, nearest
from pipeline.runtime.stage import StageConfig
from schemas.topics import BY_NAME, TOPICS

FLUSH_S, FLUSH_BYTES = 1.0, 64 << 10
"""what waits in memory is flushed after this time if it is more than this, or if something has happened"""
PARTS_WITHIN_LIMITS = 8
"""a new part begins after this share of each limit, because only whole parts are deleted"""
RECORDED = tuple(topic.name for topic in TOPICS if topic.recorded)
SAMPLES = tuple(name for name in RECORDED if BY_NAME[name].has_samples)
"""the topics that may be left out"""
RAW = "raw"
CLIPS_SHARE = 0.5
"""of what recordings and clips may take: more is not kept of clips whose alarms wait to be acknowledged"""


class RecorderConfig(StageConfig):
    """Section `[recorder]`."""

    topics: tuple[str, ...] = Field(
        default=(RAW,),
        description=f"which topics of samples are recorded, of {', '.join(SAMPLES)}; all others always are. From {RAW} "
        "`fantwin view`, `plot` and `replay --offline` make the rest again",
    )
    file: Path = Field(
        default=Path("recording.mcap"),
        description="relative to run_folder; its parts are NAME.mcap, NAME-2.mcap and so on, of a shard "
        "SHARD.NAME.mcap",
    )
    flush_interval_s: float = Field(
        default=120.0,
        gt=0,
        description="a crash of the machine loses at most this much; what fills "
        f"{FLUSH_BYTES >> 10} KiB earlier, or is an alarm, a request or a problem, or is "
        f"needed for a clip, is flushed after {FLUSH_S:g} s",
    )
    part_bytes: int = Field(default=100_000_000, ge=0, description="a new part begins at this size; 0: never")
    part_s: float = Field(default=0.0, ge=0, description="a new part begins after this time; 0: never")
    keep_days: float = Field(
        default=14.0, ge=0, description="recordings are deleted when they are older; 0: they are kept for any time"
    )
    keep_share_of_disk: float = Field(
        default=0.10,
        gt=0,
        le=1,
        description="most space for all recordings of the folder with their clips, as a share of the disk; beyond it "
        "the oldest are deleted",
    )
    min_free_bytes: int = Field(
        default=100_000_000,
        ge=0,
        description="free space to leave on the disk: below it the oldest recordings are deleted, and without any, "
        "recording pauses",
    )

    clips: bool = Field(default=True, description="keep a clip of each alarm, in the folder clips beside the recording")
    clip_before_s: float = Field(default=60.0, ge=0, le=600, description="how long before the alarm a clip begins")
    clip_after_s: float = Field(default=60.0, ge=0, le=600, description="how long after the alarm a clip ends")

    @field_validator("topics")
    @classmethod
    def _known(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for name in value:
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
    """The topics that are recorded."""
    del trays
    return tuple(name for name in RECORDED if name in config.topics or name not in SAMPLES)
