"""Messages of a tray of four fans as a site shows them to operators: scores, alarms, marks and the card of its twin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fantwin.pipeline.recordings.indexed import rare_messages
from fantwin.schemas.enums import FanState, Feedback, InvalidReason, Severity, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Diagnosis, ModelCard, Request, Score
from fantwin.schemas.units import RAD_S_PER_UNIT
from tests.support.running_core import FANS, TRAY

NOW_NS = 1_790_000_000_000_000_000
STEP_NS = 10_000_000
GOLDEN = Path(__file__).parents[1] / "support" / "data" / "golden.mcap"
SCRIPT = "<script>alert(1)</script>"


def score(seconds: float = 0.0, *, state: FanState = FanState.NORMAL, samples: int = 5) -> Score:
    """A score of fans at 1000 rpm, 10 rpm below their twins; `state` is that of fan 2, and fan 3 is not judged."""
    shape = (samples, FANS)
    states = np.full(shape, FanState.NORMAL, np.uint8)
    states[:, 2], states[:, 3] = state, FanState.UNKNOWN
    valid = states != FanState.UNKNOWN
    rpm = RAD_S_PER_UNIT["rpm"]
    return Score(
        header=Header("scorer-all-1", round(seconds * 100), TRAY),
        fans=FANS,
        period_ns=STEP_NS,
        t_ns=NOW_NS + round(seconds * 1e9) + STEP_NS * np.arange(samples),
        command=np.full(shape, 0.5, np.float32),
        measured_speed_rad_s=np.full(shape, 1000 * rpm, np.float32),
        predicted_speed_rad_s=np.full(shape, 1010 * rpm, np.float32),
        band_variance=np.full(shape, (20 * rpm) ** 2, np.float32),
        state=states,
        valid=valid,
        invalid_reason=np.where(valid, 0, InvalidReason.GAP).astype(np.uint8),
        torque_balance_command=np.full(shape, 0.01, np.float32),
        expected_residual_rad_s=np.zeros(shape, np.float32),
        expected_balance_command=np.zeros(shape, np.float32),
        score=np.full(shape, 0.5, np.float32),
        statistic=np.zeros(shape, np.uint8),
    )


def alarm(transition: Transition = Transition.RAISED, sequence: int = 0, **more: object) -> Alarm:
    values = {
        "fan": 2,
        "active": True,
        "severity": Severity.ALARM,
        "t_ns": NOW_NS,
        "onset_t_ns": NOW_NS,
        "residual_rad_s": 9.0,
        "residual_std_rad_s": 5.0,
        "message": "fan 2: 90 rpm below the twin (limit 50)",
        "transition": transition,
        "causes": (Diagnosis(cause="drag", probability=0.8, evidence="drag +20 %"),),
        **more,
    }
    return Alarm(header=Header("scorer-all-1", sequence, TRAY), **values)


def granted(request: Request) -> list[Alarm]:
    """A scorer that grants everything, and repeats the operator's words."""
    return [
        alarm(
            Transition.ACKNOWLEDGED,
            acknowledged=True,
            operator_name=request.operator_name,
            comment=request.comment,
            message=f"acknowledged by {request.operator_name}",
        )
    ]


def golden_twin() -> ModelCard:
    """It declares 24 false alarms per fan and day."""
    (card, *_) = (envelope.message for envelope in rare_messages(GOLDEN, "twin"))
    assert isinstance(card, ModelCard)
    return replace(card, header=Header("integrator", 0, TRAY))


def marked(feedback: Feedback, sequence: int, reason: str = "") -> Alarm:
    transition = Transition.MARKED_TRUE if feedback == Feedback.TRUE_ALARM else Transition.MARKED_FALSE
    more = {"feedback": feedback, "feedback_by": "ann", "feedback_reason": reason, "comment": reason}
    return alarm(transition, sequence, marked_onset_t_ns=NOW_NS, t_ns=NOW_NS + sequence, operator_name="ann", **more)
