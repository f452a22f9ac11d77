"""The topics of a site on a broker."""

from __future__ import annotations

from dataclasses import dataclass

from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.topics import ALL_TRAYS

PREFIX = "fantwin"
ALL_FANS = "all"
"""in place of the number of a fan, in a request"""
REQUEST, ANSWER = "request", "answer"
STATE, ALARM = "state", "alarm"


@dataclass(frozen=True)
class Topics:
    """Names of topics.

    Attributes:
        instance: of the process; one that has not all trays has topics about itself of its own.
    """

    site: str
    instance: str = ALL_TRAYS

    @property
    def root(self) -> str:
        """What all topics of the site begin with."""
        return f"{PREFIX}/{self.site}"

    @property
    def client_id(self) -> str:
        """Of the process. It has one so that the broker ends a connection of before, and says `offline` for it, when
        there is a new one, and not later."""
        return f"{PREFIX}-{self.site}-{self.instance}"

    @property
    def status(self) -> str:
        """Whether the stage is there: online or offline."""
        return self._own("status")

    @property
    def stages(self) -> str:
        """The stages of the site."""
        return self._own("stages")

    @property
    def summary(self) -> str:
        """How many fans there are, and how many of them are in alarm."""
        return self._own("summary")

    def state(self, fan: Fan) -> str:
        """The state of a fan."""
        return f"{self.root}/{fan}/{STATE}"

    def alarm(self, fan: Fan) -> str:
        """The current alarm of a fan."""
        return f"{self.root}/{fan}/{ALARM}"

    def transitions(self, fan: Fan) -> str:
        """Each transition of the alarm of a fan."""
        return f"{self.alarm(fan)}/transitions"

    def request(self, tray: str, fan: int | str) -> str:
        """Requests about a fan, or all fans of a tray."""
        return f"{self.root}/{tray}/{fan}/{REQUEST}"

    def requests(self, tray: str) -> str:
        """Pattern of the topics of requests about a tray."""
        return self.request(tray, "+")

    def parts(self, topic: str) -> tuple[str, str, str] | None:
        """Tray, fan and the rest of the topic of a fan; None: it is not one."""
        if not topic.startswith(f"{self.root}/"):
            return None
        parts = topic.removeprefix(f"{self.root}/").split("/")
        return (parts[0], parts[1], "/".join(parts[2:])) if len(parts) >= 3 else None

    def _own(self, name: str) -> str:
        return f"{self.root}/{name}" if self.instance == ALL_TRAYS else f"{self.root}/{name}/{self.instance}"
