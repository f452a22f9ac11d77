"""The table of alarms in the view."""

from __future__ import annotations

from itertools import count
from typing import Any

from fantwin.pipeline.outputs.rerun.alarm_log import ALARMS_LISTED, alarm_table
from fantwin.pipeline.site.alarm_book import AlarmBook
from fantwin.schemas.enums import Severity, Statistic, Transition
from fantwin.schemas.messages import Diagnosis
from tests.support import made_messages
from tests.support.score_data import START_NS


class Table:
    """Takes alarms with rising sequence numbers, and shows them."""

    def __init__(self) -> None:
        self._book = AlarmBook()
        self._numbers = count()

    def add(self, fan: int, transition: Transition, **more: Any) -> None:
        fields = {"sequence": next(self._numbers), "score": 2.0, "statistic": Statistic.DEVIATION, **more}
        self._book.add(made_messages.alarm(fan, START_NS + fan * 1_000_000_000, transition=transition, **fields))

    def text(self) -> str:
        return alarm_table(self._book.all(), START_NS)


def rows(table: Table) -> list[str]:
    return [line for line in table.text().splitlines() if line.startswith("| ")][1:]


def test_active_alarms_come_first_with_cause_and_who_has_seen_them_and_those_over_and_seen_are_gone() -> None:
    table = alarms = Table()
    assert rows(table) == [] and table.text().startswith("#### No alarms")
    alarms.add(1, Transition.RAISED)
    alarms.add(1, Transition.DIAGNOSED, causes=(Diagnosis(cause="drag_up", probability=0.9),))
    alarms.add(2, Transition.RAISED, severity=Severity.WARNING)
    alarms.add(3, Transition.RAISED)
    alarms.add(3, Transition.CLEARED, active=False)
    alarms.add(1, Transition.ACKNOWLEDGED, acknowledged=True, operator_name="ann|b")
    assert rows(table) == [
        r"| **tray1/1** | alarm | 22:13:21 | more drag 90 % | ann\|b |",
        "| **tray1/2** | warning | 22:13:22 | speed off, evidence 2 x its limit | nobody |",
        "| tray1/3 | over | 22:13:23 |  | nobody |",
    ]
    assert table.text().startswith("#### 2 active, 1 over")
    alarms.add(3, Transition.ACKNOWLEDGED, active=False, acknowledged=True)
    alarms.add(2, Transition.OUT_OF_SERVICE, severity=Severity.WARNING, out_of_service=True)
    alarms.add(1, Transition.DATA_LOST, stale=True)
    assert [row.split(" | ")[1] for row in rows(table)] == ["alarm, no data", "warning, silenced"]


def test_of_many_alarms_the_newest_are_listed_and_the_rest_counted() -> None:
    table = Table()
    for fan in range(ALARMS_LISTED + 5):
        table.add(fan, Transition.RAISED)
    assert len(rows(table)) == ALARMS_LISTED and rows(table)[0].startswith(f"| **tray1/{ALARMS_LISTED + 4}**")
    assert "and 5 more: `fantwin alarms` lists them" in table.text()
