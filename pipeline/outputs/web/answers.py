"""What the API takes and answers, as types: `openapi.json` is made of them. Times `_t_ns` are ns since 1970."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from fantwin.pipeline.site.fleet import FanGroup


class LoginForm(BaseModel):
    """Name and password."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: Annotated[str, Field(min_length=1, max_length=64)]
    password: Annotated[str, Field(min_length=1, max_length=128)]


class Problem(BaseModel):
    """Why a request was not done."""

    error: str


class Session(BaseModel):
    """A session that has begun. csrf_token: goes with every change, as header `X-CSRF-Token`."""

    name: str
    csrf_token: str


class Me(Session):
    """The visitor and its rights. name: empty without a login. has_login: users can log in here."""

    may_read: bool
    may_act: bool
    has_login: bool


class Tray(BaseModel):
    """A tray. names, places: of each fan, empty where it has none. viewer_url: of Rerun; empty without it."""

    name: str
    fans: int
    names: list[str]
    places: list[str]
    speed_unit: str
    viewer_url: str


class Channel(BaseModel):
    """What is measured of a fan beside its speed; a column of `Series`."""

    name: str
    title: str
    unit: str


class Site(BaseModel):
    """What does not change: the trays, the channels, and name, group and words for now of each class of a cell."""

    site: str
    trays: list[Tray]
    classes: list[str]
    groups: list[FanGroup]
    now: list[str]
    channels: list[Channel]
    level_at_limit: int


class Learning(BaseModel):
    """What the first twin of a fan waits for. progress: 0 to 1. until_t_ns: 0: that depends on the fan.

    missing: what the fan has not done yet; helps: what would move it; command: what to type for that. Empty: nothing.
    """

    progress: float
    what: str
    missing: str
    until_t_ns: int
    helps: str
    command: str


class Fan(BaseModel):
    """A fan in a list; null: not known now.

    name, place: empty where the configuration gives none. score: relative to its limit. deviation_percent: of the
    measured speed from the twin. deviation: in words, of an active alarm; cause, probability: its most probable causes,
    and that of the first.
    """

    tray: str
    fan: int
    name: str
    place: str
    state: str
    group: FanGroup
    score: float | None
    since_t_ns: int
    in_alarm: bool
    speed: float | None
    speed_unit: str
    command: float | None
    deviation_percent: float | None
    deviation: str
    cause: str
    probability: float | None
    learning: Learning | None


class Fans(BaseModel):
    """Fans, the worst first."""

    fans: list[Fan]


class Cause(BaseModel):
    """A possible cause of an alarm."""

    cause: str
    probability: float


class ExplainedCause(Cause):
    """A cause with what speaks for it."""

    evidence: str


class Alarm(BaseModel):
    """A current alarm. about: the message without the fan. probability: of the most probable cause. now: what its fan
    does now, in words."""

    tray: str
    fan: int
    name: str
    place: str
    about: str
    severity: str
    active: bool
    acknowledged: bool
    shelved_until_t_ns: int
    out_of_service: bool
    stale: bool
    retained: bool
    presented: bool
    onset_t_ns: int
    t_ns: int
    message: str
    message_t_ns: int
    causes: list[ExplainedCause]
    acknowledged_by: str
    feedback: str
    feedback_by: str
    feedback_reason: str
    listed: bool
    states: list[str]
    cause: str
    cause_with_share: str
    probability: float | None
    evidence: str
    advice: str
    other_causes: list[Cause]
    now: str


class Alarms(BaseModel):
    """The current alarms."""

    alarms: list[Alarm]


class Wear(BaseModel):
    """A slow change of a fan. change, error, limit: shares of its speed; null: not known."""

    parameter: str
    unit: str
    change: float | None
    error: float | None
    beside: float | None
    per_day: dict[str, float | None] | None
    days: float | None
    limit: float
    reached_t_ns: dict[str, int | None] | None
    unknown_reason: str | None
    t_ns: int


class Twin(BaseModel):
    """The twin in force, and the parameters that it uses for the fan."""

    name: str
    kind: str
    sha256: str
    since_t_ns: int
    parameters: dict[str, float]


class FanInFull(Fan):
    """A fan with its alarm, twin and wear."""

    newest_t_ns: int
    alarm: Alarm | None
    twin: Twin | None
    wear: list[Wear]


class Extremes(BaseModel):
    """A column of `Series`: least, mean and largest value at each point; null: not known."""

    min: list[float | None]
    mean: list[float | None]
    max: list[float | None]


class Happening(BaseModel):
    """A transition of the alarm of a fan, or an act of an operator on it."""

    name: str
    onset_t_ns: int
    transition: str
    severity: str
    active: bool
    message: str
    operator_name: str
    comment: str


class Mark(Happening):
    """A happening in a range of time."""

    t_s: float


class CausesFrom(BaseModel):
    """How probable each cause is from a time on, until the next; none: there is no alarm."""

    t_s: float
    probabilities: dict[str, float]


class Series(BaseModel):
    """A fan over a range of time. Points lie at `t_s`; where samples are missing there is one whose values are null.

    columns: `deviation` (measured minus predicted), `measured`, `predicted`, `half_width` of the band, all in the unit
    of the tray; `torque_balance_command`, `command`, `score` (1 is the limit), and the channels that are measured.
    bucket_s: what a point stands for. note: what is missing, and why.
    """

    tray: str
    fan: int
    speed_unit: str
    from_s: float
    to_s: float
    bucket_s: float
    t_s: list[float]
    columns: dict[str, Extremes]
    marks: list[Mark]
    causes: list[CausesFrom]
    note: str


class Spark(BaseModel):
    """The last minute of a fan, a sample a second: speeds in the unit of the tray; null: not known."""

    tray: str
    fan: int
    name: str
    t_s: list[float]
    measured: list[float | None]
    predicted: list[float | None]
    half_width: list[float | None]


class Sparks(BaseModel):
    """The last minute of all fans; of a large site, of those in alarm."""

    fans: list[Spark]


class Transition(Happening):
    """A happening in the history. feedback: the last one on its alarm. causes: the most probable first."""

    number: int
    t_ns: int
    tray: str
    fan: int
    feedback: str
    causes: list[Cause]


class History(BaseModel):
    """Transitions, the newest first. begins_t_ns: how far back the history reaches."""

    transitions: list[Transition]
    begins_t_ns: int | None


class Rate(BaseModel):
    """The observed rate of false alarms per fan and day, beside the declared one; null where no fan was judged.

    enough: fans were judged for long enough to compare the two.
    """

    since_t_ns: int
    fan_hours: float
    false_alarms: int
    true_alarms: int
    unmarked: int
    false_alarms_per_day: float | None
    interval_95: tuple[float, float] | None
    with_unmarked_per_day: float | None
    with_unmarked_interval_95: tuple[float, float] | None
    declared_per_day: float | None
    enough: bool
    text: str


class Rates(BaseModel):
    """The rates of the trays, by name, and of the site."""

    trays: dict[str, Rate]
    site: Rate


class ClippedAlarm(BaseModel):
    """An alarm in a clip."""

    fan: int
    name: str
    onset_t_ns: int
    t_ns: int


class Clip(BaseModel):
    """A recording around alarms."""

    name: str
    tray: str
    since_t_ns: int
    until_t_ns: int
    bytes: int
    acknowledged: bool
    problem: str
    alarms: list[ClippedAlarm]


class Clips(BaseModel):
    """Clips, the newest first."""

    clips: list[Clip]


class Sweep(BaseModel):
    """A sweep of the fans of a tray without a twin, which an operator may start.

    plan: which fans it moves between which commands, and for how long. running: what it does now; empty: none runs.
    ended: how the last one ended; empty: there was none.
    """

    plan: str
    running: str
    ended: str


class Stage(BaseModel):
    """A stage: its state in a word, rates, losses, latency."""

    name: str
    state: str
    detail: str
    in_hz: float
    out_hz: float
    lost: int
    latency_p50_ms: float
    latency_p99_ms: float
    uptime_s: float
    notes: list[str]


class Stages(BaseModel):
    """The stages, in the order of the data flow."""

    stages: list[Stage]


class ScorerAnswer(BaseModel):
    """What the scorer says to a request about a fan."""

    fan: int
    name: str
    transition: str
    message: str


class ScorerAnswers(BaseModel):
    """An answer for each fan."""

    answers: list[ScorerAnswer]


class Refused(Problem, ScorerAnswers):
    """The scorer has refused the request for every fan."""


JSON = dict[str, Any]
"""what `pipeline.site.site_json` makes; FastAPI checks it against the type that a path declares"""
