"""The health messages that are recorded: a stage sends one a second, and most report nothing new."""

from __future__ import annotations

from dataclasses import dataclass

from fantwin.pipeline.runtime.figures import without_figures
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.health import Health
from fantwin.schemas.units import NS_PER_S

HEALTH_S = 3600
"""longest time without a recorded message of a session"""


@dataclass
class _Session:
    said: object
    recorded_t_ns: int
    waiting: Envelope | None = None
    """its newest message, if that is not recorded"""


class RecordedHealths:
    """Selects the first and the last message of a session, one in HEALTH_S, and each that reports something new.

    New are another status or problem, and more losses.
    """

    def __init__(self) -> None:
        self._sessions: dict[str, _Session] = {}

    def is_due(self, envelope: Envelope, health: Health) -> bool:
        """Whether to record this message; if not, it is kept until a newer one comes."""
        producer, said = health.header.producer, _said(health)
        session = self._sessions.get(producer)
        age_ns = abs(envelope.received_t_ns - session.recorded_t_ns) if session else 0
        if session is None or session.said != said or age_ns >= HEALTH_S * NS_PER_S:
            self._sessions[producer] = _Session(said, envelope.received_t_ns)
            return True
        session.waiting = envelope
        return False

    def take_waiting(self) -> list[Envelope]:
        """The newest message of each session that is not recorded yet, for the end of a part.

        It says how many messages the stage has published. Sessions that have ended are forgotten.
        """
        found: list[Envelope] = []
        for producer, session in list(self._sessions.items()):
            if session.waiting is None:
                del self._sessions[producer]
            else:
                found.append(session.waiting)
                session.waiting = None
        return found


def _said(health: Health) -> object:
    """The content whose change is worth recording. Figures in the text of a problem may change each second."""
    lost = sum(line.missing for line in health.inputs)
    awaited = tuple(line.key for line in health.waiting_for)
    return health.status, without_figures(health.problem), health.lost, lost, awaited, health.is_last
