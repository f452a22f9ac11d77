"""The table of topics: name, message type, rate, and whether it is recorded; and the keys on the bus.

Recorder, health, viewer and documentation derive from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from fantwin.schemas.fields import columns, time_column
from fantwin.schemas.health import Health
from fantwin.schemas.messages import (
    Alarm,
    Clock,
    Command,
    Consumed,
    Grid,
    Message,
    ModelCard,
    NewTwin,
    Overview,
    Prediction,
    PushedSamples,
    Raw,
    Request,
    Score,
    ScorerSnapshot,
)

ON_CHANGE, AT_BREAKS = "on change", "at each break, and every 2 minutes"
KIB, MIB = 1 << 10, 1 << 20
MOST_SAMPLES, MOST_FAN_SAMPLES = 4096, 4096 * 64
"""of a message, whatever its block: samples, and samples times fans"""
ROOT = "fantwin"
HEALTH = HEALTH_CHUNK = "health"
ALIVE_CHUNK = "alive"
SESSION_CHUNK = "session"
RIGHTS_CHUNK = "rights"
RESERVED_TRAY_NAMES = (HEALTH_CHUNK, ALIVE_CHUNK, SESSION_CHUNK, RIGHTS_CHUNK)
ALL_TRAYS = "all"
"""the instance of a process that has all trays of its site"""


@dataclass(frozen=True)
class Topic:
    """One topic.

    Attributes:
        history: a producer keeps this many of its last messages for consumers that begin, as far as its memory
            allows (`pipeline.bus.publisher`).
        largest_bytes: a longer message is refused before it is decoded. The largest that any configuration makes is
            half of it or less (`most_samples`).
    """

    name: str
    message: type[Message]
    rate: str
    recorded: bool
    history: int
    largest_bytes: int
    about: str
    kept_after_cut: int = 0
    """a producer keeps so many for consumers that were cut off, if these are more than `history`"""
    is_needed_first: bool = False
    """a consumer that begins needs its last message before those of other topics"""
    is_of_people: bool = False
    """people and programs that are no stage publish it too"""
    is_summary: bool = False
    """its rows are made from many samples: few bytes, so they are recorded whatever samples are"""
    is_of_session: bool = False
    """about a session of a stage: a live replay does not publish it, since that session does not run"""

    @property
    def kept(self) -> int:
        """How many of its last messages a producer keeps, as far as its memory allows."""
        return max(self.history, self.kept_after_cut)

    @property
    def has_samples(self) -> bool:
        """Its messages are blocks of samples, nearly all bytes of a recording: a recorder may leave them out."""
        return time_column(self.message) in columns(self.message) and not self.is_summary

    @property
    def is_rare(self) -> bool:
        """Published seldom: every consumer needs each message, and asking for it again is cheap."""
        return self.rate in (ON_CHANGE, AT_BREAKS)


CATCH_UP_MESSAGES = 4096
"""a consumer that begins asks for no more of each stream: 3 minutes in blocks of 0.05 s, enough for one that
replaces another that hung"""

TOPICS: tuple[Topic, ...] = (
    Topic(
        "raw",
        Raw,
        "as the device sends, often 100 Hz",
        True,
        8192,
        16 * MIB,
        "accepted samples of the source, at their own times",
    ),
    Topic(
        "reading",
        PushedSamples,
        "as the client sends",
        False,
        CATCH_UP_MESSAGES,
        16 * MIB,
        "samples of a client",
        is_of_people=True,
    ),
    Topic("grid", Grid, "the grid's rate over the block size", True, 8192, 16 * MIB, "samples on a uniform grid"),
    Topic("prediction", Prediction, "as grid", True, 8192, 32 * MIB, "the healthy twin beside the measurement"),
    Topic("score", Score, "as prediction", True, 8192, 64 * MIB, "scored samples, ready to draw"),
    Topic(
        "overview",
        Overview,
        "once in 10 s",
        True,
        64,
        2 * MIB,
        "twin, deviation and score of each second",
        is_summary=True,
    ),
    Topic("alarm", Alarm, ON_CHANGE, True, CATCH_UP_MESSAGES, MIB, "transitions of alarms"),
    Topic("request", Request, ON_CHANGE, True, 64, 64 * KIB, "requests of operators about alarms", is_of_people=True),
    Topic(
        "snapshot", ScorerSnapshot, "on change, and regularly", True, 4, 96 * MIB, "a scorer's state for a restart", 64
    ),
    Topic("command", Command, ON_CHANGE, True, 64, 64 * KIB, "commands and set-points for the fans", is_of_people=True),
    Topic("twin", ModelCard, ON_CHANGE, True, 8, 16 * MIB, "the twin in force", is_needed_first=True),
    Topic(
        "new_twin", NewTwin, ON_CHANGE, False, 2, 16 * MIB, "a learned twin that is to take over", is_needed_first=True
    ),
    Topic(
        "consumed",
        Consumed,
        AT_BREAKS,
        True,
        1024,
        4 * KIB,
        "what a session of a stage has consumed",
        is_of_session=True,
    ),
    Topic("clock", Clock, "20 Hz", False, 1, 4 * KIB, "position of a replay"),
    Topic(
        "health",
        Health,
        "1 Hz for each stage",
        True,
        16,
        2 * MIB,
        "status and losses of a stage",
        1024,
        is_of_session=True,
    ),
)
BY_NAME = {topic.name: topic for topic in TOPICS}


def most_samples(fans: int) -> int:
    """The most samples of a message of so many fans: what is more goes into the next one."""
    return max(1, min(MOST_SAMPLES, MOST_FAN_SAMPLES // fans))


def largest_bytes(key: str) -> int:
    """The length of the longest message that is accepted on a key or key expression, in bytes."""
    topic = known_topic(key)
    return topic.largest_bytes if topic else max(topic.largest_bytes for topic in TOPICS)


def makes_samples_of_samples(reads: Sequence[str], writes: Sequence[str]) -> bool:
    """Whether whoever reads and writes these topics, the main input first, makes blocks of samples from samples."""
    return bool(reads) and BY_NAME[reads[0]].has_samples and any(BY_NAME[name].has_samples for name in writes)


def tray_key(site: str, tray: str, topic: str) -> str:
    """Key of a tray's topic; `*` may stand for site or tray."""
    return f"{ROOT}/{site}/{tray}/{topic}"


def tray_of(key: str) -> str:
    """The tray in the key of a tray's topic."""
    return key.split("/")[2]


def health_key(site: str, stage: str, instance: str) -> str:
    """Key of a stage's health; `*` may stand for any part."""
    return f"{ROOT}/{site}/{HEALTH_CHUNK}/{stage}/{instance}"


def stage_label(stage: str, instance: str) -> str:
    """The name of a process of a stage for people: `scorer`, or `scorer/2-of-8` where it does not have all trays."""
    return stage if instance == ALL_TRAYS else f"{stage}/{instance}"


def alive_key(site: str, stage: str, instance: str) -> str:
    """Key of a stage's liveliness token; `*` may stand for any part."""
    return f"{ROOT}/{site}/{ALIVE_CHUNK}/{stage}/{instance}"


def sessions_key(site: str, stage: str = "*", instance: str = "*") -> str:
    """Pattern of the keys of the tokens that say which process runs a stage; `pipeline.runtime.sessions` makes them."""
    return f"{ROOT}/{site}/{SESSION_CHUNK}/{stage}/{instance}/**"


def session_key(site: str, stage: str, instance: str, *parts: object) -> str:
    """Key of the token of one session.

    parts: its start, producer, host and process id, and its trays unless it has all.
    """
    return "/".join((sessions_key(site, stage, instance).removesuffix("/**"), *map(str, parts)))


def rights_key(site: str, role: str) -> str:
    """Key at which a router answers what a role may do; `*` may stand for any role."""
    return f"{ROOT}/{site}/{RIGHTS_CHUNK}/{role}"


def sweep_key(site: str, tray: str) -> str:
    """Key of the liveliness token of a sweep that moves a tray's commands."""
    return f"{ROOT}/{site}/{tray}/sweep"


def key_in_words(key: str) -> str:
    """A tray's topic for people: `grid of tray1`. What is no key, as another program may send it, stays as it is."""
    *_, tray, topic = ["", *key.split("/")]
    return f"{topic} of {tray}" if tray else key


def topic_of(key: str) -> Topic:
    """The topic of a key.

    Raises:
        KeyError: no topic of fantwin has such a key.
    """
    parts = key.split("/")
    if len(parts) == 5 and parts[0] == ROOT and parts[2] == HEALTH_CHUNK:
        return BY_NAME["health"]
    if len(parts) == 4 and parts[0] == ROOT:
        return BY_NAME[parts[3]]
    raise KeyError(key)


@lru_cache(4096)
def known_topic(key: str) -> Topic | None:
    """The topic of a key, which may be of another program: None."""
    try:
        return topic_of(key)
    except KeyError:
        return None
