"""The one table of topics: what is published where, by whom it is kept, and which message it is.

Recorder, health, viewer and documents derive from it.
"""

from __future__ import annotations

from dataclasses import dataclass

from schemas.messages import (
    Alarm,
    Clock,
    Command,
    Grid,
    Health,
    Message,
    ModelCard,
    Prediction,
    Raw,
    Request,
    Score,
    ScorerSnapshot,
)

ON_CHANGE = "on change"
ROOT = "fantwin"
HEALTH_CHUNK = "health"
ALIVE_CHUNK = "alive"
RESERVED_TRAY_NAMES = (HEALTH_CHUNK, ALIVE_CHUNK)


@dataclass(frozen=True)
class Topic:
    """One row. `history` is how many messages a producer keeps for those who missed them."""

    name: str
    message: type[Message]
    rate: str
    recorded: bool
    history: int
    about: str

    @property
    def is_rare(self) -> bool:
        """Said once, when it changes: nobody can do without, and asking for it again costs nothing."""
        return self.rate == ON_CHANGE


TOPICS: tuple[Topic, ...] = (
    Topic("raw", Raw, "as the device sends, often 100 Hz", True, 1024, "samples as the device sent them"),
    Topic("grid", Grid, "the grid's rate over the block size", True, 1024, "samples on a uniform grid"),
    Topic("prediction", Prediction, "as grid", True, 1024, "the healthy twin beside the measurement"),
    Topic("score", Score, "as prediction", True, 1024, "judged samples, ready to draw"),
    Topic("alarm", Alarm, ON_CHANGE, True, 1024, "what happened to an alarm"),
    Topic("request", Request, ON_CHANGE, True, 64, "what an operator wants of the alarms"),
    Topic("snapshot", ScorerSnapshot, "on change, and each minute", True, 4, "what a scorer must not forget"),
    Topic("command", Command, ON_CHANGE, True, 64, "what is wanted of the fans"),
    Topic("twin", ModelCard, ON_CHANGE, True, 8, "the twin in force"),
    Topic("clock", Clock, "20 Hz", False, 1, "the time of a replay"),
    Topic("health", Health, "1 Hz for each stage", True, 8, "how a stage is"),
)
BY_NAME = {topic.name: topic for topic in TOPICS}
FORMER_NAMES = {"memory": "snapshot"}
"""what topics were called in recordings of earlier versions"""


def tray_key(site: str, tray: str, topic: str) -> str:
    """Key of a tray's topic; `*` may stand for site or tray."""
    return f"{ROOT}/{site}/{tray}/{topic}"


def health_key(site: str, stage: str, instance: str) -> str:
    """Key of a stage's health; `*` may stand for any part."""
    return f"{ROOT}/{site}/{HEALTH_CHUNK}/{stage}/{instance}"


def alive_key(site: str, stage: str, instance: str) -> str:
    """Key of a stage's liveliness token; `*` may stand for any part."""
    return f"{ROOT}/{site}/{ALIVE_CHUNK}/{stage}/{instance}"


def topic_of(key: str) -> Topic:
    """The topic a key belongs to.

    Raises:
        KeyError: not a key of ours.
    """
    parts = key.split("/")
    if len(parts) == 5 and parts[0] == ROOT and parts[2] == HEALTH_CHUNK:
        return BY_NAME["health"]
    if len(parts) == 4 and parts[0] == ROOT:
        return BY_NAME[FORMER_NAMES.get(parts[3], parts[3])]
    raise KeyError(key)
