"""The settings of the recorder, and which topics it records with them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pydantic import Field, field_validator

from fantwin.pipeline.config.settings import TrayConfig, nearest
from fantwin.pipeline.runtime.stage import StageConfig
from fantwin.schemas.topics import BY_NAME, TOPICS

FLUSH_S, FLUSH_BYTES = 1.0, 64 << 10
"""messages in memory are flushed after this time if they are more than this, or if one of them is urgent"""
PART_BYTES, PART_S = 100_000_000, 86_400.0
"""the recorder begins a new file, a part, at this size and after this time, and earlier where the limits are small"""
LONGEST_FLUSH_S = 120.0
"""all others are flushed after this time: a crash of the machine loses at most this much; more flushes wear a memory
card"""
PARTS_WITHIN_LIMITS = 8
"""parts within each limit, because only whole parts are deleted"""
RECORDED = tuple(topic.name for topic in TOPICS if topic.recorded)
SAMPLES = tuple(name for name in RECORDED if BY_NAME[name].has_samples)
"""the topics that may be left out"""
RAW = "raw"
CLIPS_SHARE = 0.5
"""share of the space for recordings and clips that clips with unacknowledged alarms may fill"""


class RecorderConfig(StageConfig):
    """Section `[recorder]`."""

    topics: tuple[str, ...] = Field(
        default=(RAW,),
        description=f"which topics of samples to record, of {', '.join(SAMPLES)}; all others are always recorded. "
        f"`fantwin view` and `replay --offline` make the rest again from {RAW}",
    )
    file: Path = Field(
        default=Path("recording.mcap"),
        description="relative to run_folder; its parts are NAME.mcap, NAME-2.mcap and so on, of a shard "
        "SHARD.NAME.mcap",
    )
    keep_days: float = Field(
        default=14.0, ge=0, description="older recordings are deleted; 0: none is deleted because of its age"
    )
    keep_share_of_disk: float = Field(
        default=0.10,
        gt=0,
        le=1,
        description="most space for all recordings and clips of the folder, as a share of the disk; the oldest are "
        "deleted beyond it",
    )

    @field_validator("topics")
    @classmethod
    def _known(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for name in value:
            if name not in RECORDED:
                raise ValueError(f"unknown topic {name!r}{nearest(name, SAMPLES)}")
            if name not in SAMPLES:
                raise ValueError(f"{name} is always recorded: name only topics of samples, {', '.join(SAMPLES)}")
        return value


def recorded_topics(config: RecorderConfig, trays: Sequence[TrayConfig]) -> tuple[str, ...]:
    """The topics that are recorded."""
    del trays
    return tuple(name for name in RECORDED if name in config.topics or name not in SAMPLES)
