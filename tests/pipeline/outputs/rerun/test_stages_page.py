from __future__ import annotations

from dataclasses import replace

from fantwin.pipeline.outputs.rerun.stages_page import CHANGES_SHOWN, PROBLEMS_LISTED, StagesPage
from fantwin.pipeline.site.site_model import SILENT_AFTER_S, SiteModel
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.header import Header
from fantwin.schemas.health import AwaitedInput, Health
from fantwin.schemas.messages import ModelCard

NOW_NS = 1_760_000_000_000_000_000  # 2025-10-09 08:53:20


def health(
    stage: str = "scorer",
    instance: str = "all",
    *,
    status: StageStatus = StageStatus.OK,
    lost: int = 0,
    problem: str = "",
) -> Health:
    return Health(stage=stage, instance=instance, status=status, t_ns=NOW_NS, uptime_s=1.0, lost=lost, problem=problem)


class Page:
    """The page of a viewer, at a time that the test sets."""

    def __init__(self, *healths: Health) -> None:
        self.now_s = 0.0
        self._model = SiteModel("site", (), now_s=lambda: self.now_s)
        self._page = StagesPage()
        self.twins: dict[str, ModelCard] = {}
        for one in healths:
            self.add_health(one)

    def add_health(self, one: Health) -> None:
        self._model.add_health(one)
        self._page.add_health(one)

    def text(self) -> str:
        return self._page.text(self._model.stages(), self.twins)


def section(text: str, title: str) -> list[str]:
    """The lines under a title; none if there is no such title."""
    parts = text.split("## ")
    return next((part.splitlines()[2:] for part in parts if part.startswith(title)), [])


def test_every_stage_has_a_row_and_is_silent_without_new_health_unless_it_stopped_in_order() -> None:
    latest = Page(health(status=StageStatus.STARTING), health("acquisition", "tray1", lost=3), health())
    rows = ["| acquisition/tray1 | ok | **3** |", "| scorer | ok | 0 |"]
    assert [row for row in section(latest.text(), "Stages now") if row][2:] == rows
    page = Page(health("scorer"), health("resampler", status=StageStatus.STOPPED))
    page.now_s = SILENT_AFTER_S
    assert "silent" not in page.text()
    page.now_s += 0.1
    assert "| scorer | **silent** | 0 |" in page.text() and "| resampler | **stopped** | 0 |" in page.text()
    page.add_health(health("scorer"))
    assert "| scorer | ok | 0 |" in page.text()


def test_changes_are_listed_once_newest_first_with_their_time() -> None:
    ill = health(status=StageStatus.DEGRADED, problem="no port")
    page = Page(health(), health(), ill, ill, health(lost=12))
    assert [line for line in section(page.text(), "Last changes") if line] == [
        "- 2025-10-09 08:53:20 scorer: ok, 12 lost",
        "- 2025-10-09 08:53:20 scorer: degraded: no port",
        "- 2025-10-09 08:53:20 scorer: ok",
    ]


def test_the_page_stays_short_however_many_changes_there_are() -> None:
    page = Page()
    for number in range(1000):
        ill = health(status=StageStatus.DEGRADED, problem=f"problem {number} " + "x" * 10_000)
        page.add_health(ill)
    text = page.text()
    assert len([line for line in section(text, "Last changes") if line]) == CHANGES_SHOWN == 20
    assert "problem 999" in text and "problem 979" not in text and len(text) < 6000


def test_text_of_stages_is_never_interpreted_as_markup() -> None:
    page = Page(health("twin_integrator", status=StageStatus.DEGRADED, problem="a | b\n# *c* [[tray]] `fans` <d>"))
    text = page.text()
    assert r"a \| b \# \*c\* \[\[tray\]\] \`fans\` \<d\>" in text and r"| twin\_integrator |" in text


def test_row_01_a_stage_that_waits_for_its_input_is_named() -> None:
    awaited = AwaitedInput(key="fantwin/s/tray1/grid", since_t_ns=0)
    page = Page(replace(health("scorer"), waiting_for=(awaited,)))
    assert section(page.text(), "What is wrong")[0] == "- **scorer**: waits for grid of tray1"


def test_of_many_instances_only_those_that_are_not_well_have_a_row() -> None:
    page = Page(*(health("acquisition", f"rack{number}") for number in range(157)))
    page.add_health(health("acquisition", "rack3", lost=2))
    page.add_health(health("acquisition", "rack5", status=StageStatus.DEGRADED, problem="no port"))
    assert [row for row in section(page.text(), "Stages now") if row][2:] == [
        "| acquisition/rack3 | ok | **2** |",
        "| acquisition/rack5 | **degraded** | 0 |",
        "| acquisition: 155 of 157 | ok | 0 |",
    ]


def test_a_fleet_in_trouble_has_a_short_page() -> None:
    awaited = tuple(AwaitedInput(key=f"fantwin/s/rack{number}/grid", since_t_ns=0) for number in range(157))
    page = Page(replace(health("scorer"), waiting_for=awaited))
    assert section(page.text(), "What is wrong")[0] == (
        "- **scorer**: waits for grid of rack0, grid of rack1, grid of rack2 and 154 more"
    )
    for number in range(157):
        page.add_health(health("acquisition", f"rack{number}", status=StageStatus.DEGRADED, problem="no port"))
        card = ModelCard(header=Header("x", 0, ""), t_ns=NOW_NS, twin="f40", kind="hybrid", sha256="")
        page.twins[f"rack{number}"] = card
    wrong = [line for line in section(page.text(), "What is wrong") if line]
    assert len(wrong) == PROBLEMS_LISTED + 1 and wrong[-1] == "- and 138 more"
    assert section(page.text(), "Twins in force")[0] == (
        "- 157 trays: f40 (hybrid), the last since 2025-10-09 08:53:20"
    )
