"""What `fantwin up` says of a running site."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fantwin.pipeline.launch.site_report import RunningProcess, SiteReport
from fantwin.pipeline.site.site_watcher import StageView
from fantwin.pipeline.site.stage_states import StageState, Word
from fantwin.schemas.enums import Transition
from fantwin.schemas.health import Note
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.current_alarms import clock, current_alarm
from tests.support.made_messages import alarm
from tests.support.stage_views import CONSUMER, view

IDS = {"resampler": RunningProcess(11, is_at_work=True), "scorer": RunningProcess(12, is_at_work=True)}


@pytest.fixture
def lines() -> list[str]:
    return []


@pytest.fixture
def report(lines: list[str]) -> SiteReport:
    return SiteReport("tcp/x:1", lines.append, CONSUMER.t_ns - NS_PER_S)


def state(label: str, word: Word = Word.OK, detail: str = "") -> StageState:
    return StageState(label, word, detail, None, is_expected=True)


def test_row_16_a_lost_connection_is_said_once_and_that_it_is_back(report, lines):
    for seconds in range(3):
        report.stages([state("resampler", Word.GONE, f"last heard {seconds} s ago"), state("scorer")], IDS)
    report.stages([state("resampler"), state("scorer")], IDS)
    assert lines == [
        "resampler: the connection to the bus is lost: process 11 works, but is not heard at tcp/x:1",
        "resampler: at work again",
    ]


def test_row_16_a_router_that_is_gone_is_one_line(report, lines):
    report.stages([state("resampler", Word.GONE), state("scorer", Word.MISSING)], IDS)
    report.stages([state("resampler"), state("scorer", Word.GONE)], IDS)  # they come back one after the other
    report.stages([state("resampler"), state("scorer")], IDS)
    assert lines == [
        "all stages: the connection to the bus is lost: they work, but none of them is heard at tcp/x:1",
        "all stages: heard on the bus again",
    ]


def test_row_01_a_stage_that_hangs_is_said_once_and_that_it_works_again(report, lines):
    hangs = {"resampler": RunningProcess(11, is_at_work=False), "scorer": IDS["scorer"]}
    for word in (Word.SILENT, Word.SILENT, Word.GONE, Word.MISSING):
        report.stages([state("resampler", word), state("scorer")], hangs)
    report.stages([state("resampler"), state("scorer")], IDS)
    assert lines == [
        "resampler: silent: it hangs, is blocked or gets no processor time",
        "resampler: at work again",
    ]


def test_row_01_a_stage_that_starves_is_said_until_it_works_again_and_one_without_a_process_is_left_to_the_launcher(
    report, lines
):
    for word, detail in ((Word.STARVED, "nothing for 6 s"), (Word.STARVED, "nothing for 7 s"), (Word.OK, "")):
        report.stages([state("resampler", word, detail), state("scorer", Word.GONE)], {"resampler": IDS["resampler"]})
    assert lines == ["resampler: starved: nothing for 6 s", "resampler: at work again"]


def test_row_18_a_problem_whose_figures_change_is_said_once(report, lines):
    for free in ("12.3", "11.9", "11.5"):
        health = replace(CONSUMER, problem=f"{free} MB are free on the disk, but 100.0 MB are required")
        before = replace(health, t_ns=health.t_ns - NS_PER_S)
        report.stages([replace(state("recorder"), view=StageView(health, before, alive=True))], {})
    report.stages([replace(state("recorder"), view=view(CONSUMER))], {})
    assert lines == [
        "recorder: 12.3 MB are free on the disk, but 100.0 MB are required",
        "recorder: the problem is resolved",
    ]


def test_a_problem_from_before_the_sources_started_or_of_a_moment_is_not_said(lines):
    report = SiteReport("tcp/x:1", lines.append, CONSUMER.t_ns - NS_PER_S)

    def hear(t_ns: int, problem: str, before: str) -> None:
        health = replace(CONSUMER, t_ns=t_ns, problem=problem)
        previous = replace(health, t_ns=t_ns - NS_PER_S, problem=before)
        report.stages([replace(state("resampler"), view=StageView(health, previous, alive=True))], {})

    silent = "no raw samples"
    hear(CONSUMER.t_ns - NS_PER_S, silent, silent)  # before the line was opened
    hear(CONSUMER.t_ns - 1, silent, silent)
    hear(CONSUMER.t_ns + NS_PER_S, "", silent)
    hear(CONSUMER.t_ns + 2 * NS_PER_S, silent, "")
    hear(CONSUMER.t_ns + 3 * NS_PER_S, "", silent)
    assert lines == []
    hear(CONSUMER.t_ns + 5 * NS_PER_S, silent, silent)
    assert lines == ["resampler: no raw samples"]


def test_what_a_stage_notes_of_its_work_is_said_once_when_it_has_stood_for_some_seconds(report, lines):
    def hear(second: int, *notes: str) -> None:
        health = replace(
            CONSUMER, t_ns=CONSUMER.t_ns + second * NS_PER_S, notes=[Note(tray="tray1", text=each) for each in notes]
        )
        report.stages([replace(state("resampler"), view=view(health))], {})

    for second in range(3):
        hear(second, f"the rate of the line is being measured ({10 * second} samples so far)")
    for second in range(3, 30):
        judged = [f"{second:.1f} % of the fans' samples judged; not judged: {100 - second:.1f} % in gaps"] * (
            second > 20
        )
        hear(second, f"grid of 10 Hz (the line sends 9.9{second % 3} samples a second); gaps: {second}", *judged)
    assert lines == [
        "twin_integrator, tray1: grid of 10 Hz (the line sends 9.92 samples a second); gaps: 8",
        "twin_integrator, tray1: 26.0 % of the fans' samples judged; not judged: 74.0 % in gaps",
    ]
    for second in range(30, 40):
        hear(second, "grid of 20 Hz (the line sends 19.9 samples a second); gaps: 0")
    assert lines[2:] == ["twin_integrator, tray1: grid of 20 Hz (the line sends 19.9 samples a second); gaps: 0"]


def test_a_stage_that_works_off_what_was_missed_during_a_restart_is_not_late(report, lines):
    def hear(second: int, word: Word) -> None:
        health = replace(CONSUMER, t_ns=CONSUMER.t_ns + second * NS_PER_S)
        late = replace(state("scorer", word, "its outputs are 60 s old when they are sent"), view=view(health))
        report.stages([state("resampler"), late], IDS)

    for second in range(10):
        hear(second, Word.LATE)
    hear(10, Word.OK)
    assert lines == []
    for second in range(20, 40):
        hear(second, Word.LATE)
    assert lines == ["scorer: late: its outputs are 60 s old when they are sent"]


def test_an_alarm_that_came_and_went_between_two_looks_is_said_to_have_been_raised(report, lines):
    def cleared(onset_t_ns: int) -> Alarm:
        over = {"transition": Transition.CLEARED, "active": False, "message": "fan 2: back to normal"}
        return alarm(2, onset_t_ns + NS_PER_S, onset_t_ns=onset_t_ns, **over)

    from_before, seen, missed, shelved = (CONSUMER.t_ns + seconds * NS_PER_S for seconds in (-60, 10, 20, 30))
    for newest in (
        cleared(from_before),
        alarm(2, seen, transition=Transition.RAISED, message="fan 2: 214 rpm below the twin"),
        cleared(seen),
        cleared(missed),
        cleared(missed),
        replace(cleared(shelved), shelved_until_t_ns=shelved + 3600 * NS_PER_S),
    ):
        report.alarms([current_alarm([newest])])
    over = "cleared  tray1  fan 2: back to normal"
    raised = f"ALARM  tray1  fan 2: raised for what began at {clock(missed)}, and over"
    silenced = f"ALARM (silenced)  tray1  fan 2: raised for what began at {clock(shelved)}, and over"
    assert lines == [over, "ALARM  tray1  fan 2: 214 rpm below the twin", over, raised, over, silenced, over]
