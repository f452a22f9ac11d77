"""Messages of a tray of four fans as a site shows them to operators: scores, alarms, marks and the card of its twin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.recordings.indexed import rare_messages
from fantwin.schemas.enums import FanState, Feedback, InvalidReason, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Diagnosis, ModelCard, Request, Score
from fantwin.schemas.units import RAD_S_PER_UNIT
from tests.support import made_messages
from tests.support.made_messages import filled
from tests.support.running_core import FANS, TRAY

NOW_NS = 1_790_000_000_000_000_000
STEP_NS = 10_000_000
GOLDEN = Path(__file__).parents[1] / "support" / "data" / "golden.mcap"
SCRIPT = "<script>alert(1)</script>"


def score(seconds: float = 0.0, *, state: FanState = FanState.NORMAL, samples: int = 5) -> Score:
    """A score of fans at 1000 rpm, 10 rpm below their twins; `state` is that of fan 2, and fan 3 is not judged."""
    states = np.full((samples, FANS), FanState.NORMAL, np.uint8)
    states[:, 2], states[:, 3] = state, FanState.UNKNOWN
    valid = states != FanState.UNKNOWN
    rpm = RAD_S_PER_UNIT["rpm"]
    return filled(
        Score,
        samples,
        FANS,
        header=Header("scorer-all-1", round(seconds * 100), TRAY),
        period_ns=STEP_NS,
        t_ns=NOW_NS + round(seconds * 1e9) + STEP_NS * np.arange(samples),
        command=0.5,
        measured_speed_rad_s=1000 * rpm,
        predicted_speed_rad_s=1010 * rpm,
        band_variance=(20 * rpm) ** 2,
        state=states,
        valid=valid,
        invalid_reason=np.where(valid, 0, InvalidReason.GAP),
        torque_balance_command=0.01,
        score=0.5,
    )


def alarm(transition: Transition = Transition.RAISED, sequence: int = 0, **more: Any) -> Alarm:
    values: dict[str, Any] = {
        "residual_rad_s": 9.0,
        "residual_std_rad_s": 5.0,
        "message": "fan 2: 90 rpm below the twin (limit 50)",
        "causes": (Diagnosis(cause="drag", probability=0.8, evidence="drag +20 %"),),
        **{"fan": 2, "t_ns": NOW_NS, "onset_t_ns": NOW_NS, "transition": transition},
    }
    return made_messages.alarm(tray=TRAY, producer="scorer-all-1", sequence=sequence, **(values | more))


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
