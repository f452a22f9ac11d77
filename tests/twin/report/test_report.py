"""`fantwin report`: one page, right in its figures and in what to record next, whole without the network."""

from __future__ import annotations

import json
import re
from dataclasses import astuple, replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fantwin.schemas.model_uncertainty import ModelUncertainty
from fantwin.schemas.twin_card import DataCard, DriveCard
from fantwin.twin.build import runs_of_twin
from fantwin.twin.export.onnx_twin import OnnxTwin
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.models.physics import PARAMETER_NAMES
from fantwin.twin.report import figures
from fantwin.twin.report.assessment import assess, least_known
from fantwin.twin.report.content import Content, SpeedUnit, report_content, summary_of
from fantwin.twin.report.page import MOST_FANS_DRAWN, drawn_fans, report_page
from fantwin.twin.report.recording_sums import common_extent, extent_of, recording_sums
from fantwin.twin.report.steady_states import StaticCurve, static_curve
from fantwin.twin.report.timeline import broken_at, kept_samples, timeline
from fantwin.twin.runs import Run
from tests.support.fan_data import PUBLISHED_PARAMETERS, published_run, rough_run
from tests.support.fantwin_command import fantwin
from tests.support.page_browser import measured
from tests.support.uncertainty_tables import by_speed
from tests.support.written_recordings import write_run as record

SECTIONS = ["assessment", "figures", "alarms", "parameters", "fan-0", "fan-1", "meaning", "card"]
TITLES = [
    "Fit and error over time",
    "Around the largest error",
    "Histogram of the error",
    "Whiteness",
    "Cross-correlation with the command",
    "Static curve",
    "Error over speed",
]
TITLES_OF_HYBRID = [*TITLES, "What the twin knows"]
RAD_S = SpeedUnit("rad/s", 1.0)
SMALLEST_TEXT_UNITS = 8.5 * 0.88
"""Height of the smallest text of a figure in the units of its viewBox (points)."""


class Page(HTMLParser):
    """The contents of a page: ids, references, section ids, captions, machine-readable numbers by table row."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.references: list[str] = []
        self.tags: set[str] = set()
        self.sections: list[str] = []
        self.numbers: dict[str, list[float]] = {}
        self.text = ""
        self._row = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.tags.add(tag)
        if given.get("id"):
            self.ids.append(str(given["id"]))
        self.references += [str(given[name]) for name in ("src", "href", "xlink:href", "srcset") if name in given]
        if tag == "section":
            self.sections.append(str(given["id"]))
        if tag == "tr":
            self._row = given.get("id") or ""
        if tag == "data":
            self.numbers.setdefault(self._row, []).append(float(str(given["value"])))

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of published fans, and the twins of one and of two."""
    path = tmp_path_factory.mktemp("report")
    for name, first_seed, fans in (("one", 1, 1), ("two", 11, 2)):
        runs = {"healthy": published_run(first_seed, 30.0, fans), "held-out": published_run(first_seed + 1, 30.0, fans)}
        (path / name).mkdir()
        for of, run in runs.items():
            record(path / name / f"{of}.mcap", run, unit="rpm")
        common = ("--model", "physical", "--command-unit", "%")
        recordings = (path / name / "healthy.mcap", "--validate", path / name / "held-out.mcap")
        made = fantwin("train", *recordings, *common, "-o", path / name / "twin.onnx")
        assert made.exit_code == 0, made.output
    return path


@pytest.fixture(scope="module")
def twin(folder: Path) -> OnnxTwin:
    return OnnxTwin(folder / "one" / "twin.onnx")


@pytest.fixture(scope="module")
def reported(folder: Path) -> dict[str, Any]:
    """What the command says of the page that it wrote."""
    words = (folder / "two" / "twin.onnx", folder / "two" / "held-out.mcap", "-o", folder / "page.html", "--json")
    result = fantwin("report", *words)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def page(folder: Path, reported: dict[str, Any]) -> str:
    assert reported["bytes"] == (folder / "page.html").stat().st_size
    return (folder / "page.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def evaluated(folder: Path) -> dict[str, Any]:
    of = folder / "two"
    return json.loads(fantwin("evaluate", of / "twin.onnx", of / "held-out.mcap", "--json").stdout)


@pytest.fixture(scope="module")
def hybrid(folder: Path) -> OnnxTwin:
    """A twin whose card says what it knows: it uses its network."""
    record(folder / "rough.mcap", rough_run(1, 30.0))
    words = ("--iterations", 5, "--networks", 1)
    made = fantwin("train", folder / "rough.mcap", *words, "-o", folder / "hybrid.onnx")
    assert made.exit_code == 0, made.output
    return OnnxTwin(folder / "hybrid.onnx")


@pytest.fixture(scope="module")
def content_of_hybrid(hybrid: OnnxTwin) -> Content:
    return content_of(hybrid, rough_run(2, 30.0))


@pytest.fixture(scope="module")
def page_of_hybrid(content_of_hybrid: Content) -> str:
    return report_page(content_of_hybrid)


def content_of(twin: OnnxTwin, *runs: Run, unit: SpeedUnit = RAD_S) -> Content:
    return report_content(twin, runs, [DataCard("runs.mcap", "0" * 64, runs[0].fans, runs[0].samples)], unit)


def with_speed(run: Run, speed_rad_s: np.ndarray) -> Run:
    return Run(run.name, run.t_s, run.command, speed_rad_s)


def test_the_page_holds_every_section_and_every_figure_and_needs_nothing_but_itself(page):
    parsed = Page(page)
    assert parsed.sections == SECTIONS
    assert [title for title in TITLES if title in parsed.text] == TITLES
    assert page.count("<svg ") == 2 * (len(TITLES) + 1)  # time is drawn twice: for wide screens and for phones
    for expected in ("physical twin of 2 fans", "held-out data", "95%", "sha256"):
        assert expected in parsed.text
    assert not parsed.tags & {"script", "link", "iframe", "img", "object", "embed"}
    assert all(reference.startswith("#") for reference in parsed.references)
    assert not re.search(r"url\((?!#)|@import", page)
    assert len(parsed.ids) == len(set(parsed.ids))
    targets = {reference[1:] for reference in parsed.references} | set(re.findall(r"url\(#([^)]*)\)", page))
    assert targets <= set(parsed.ids)
    of_all = re.search(r"over ([\d,]+) of\s([\d,]+) samples, without the first 3 s of each run", parsed.text)
    assert of_all and of_all[1] != of_all[2], parsed.text


def test_json_and_page_hold_the_figures_of_evaluate(reported, page, evaluated):
    assert reported["speed_unit"] == evaluated["speed_unit"]
    for figure in ("rmse", "max_error", "r2", "coverage_2_sigma", "one_step_rmse", "samples"):
        assert reported[figure] == evaluated[figure]
        assert reported["fans"][0][figure] == evaluated["fans"][0][figure]
    assert (reported["assessment"], reported["fans"][0]["fan"]) == ("not tested", 0)
    assert Page(page).numbers["row-0"][0] == pytest.approx(evaluated["fans"][0]["rmse"], rel=1e-12)


def test_a_healthy_fan_is_followed_as_declared_and_without_a_warning(twin):
    judged = assess(content_of(twin, published_run(5, 30.0)))
    assert (judged.level, judged.warnings) == ("as declared", ())
    assert judged.headline == "The twin follows this fan as closely as its card says."


def test_a_fan_that_runs_slow_is_not_followed_and_the_page_says_by_how_much(twin, monkeypatch):
    monkeypatch.setattr("fantwin.twin.report.page.fan_figures", lambda *_: [])  # it is about the words
    healthy = published_run(5, 30.0)
    content = content_of(twin, with_speed(healthy, 0.9 * healthy.speed_rad_s))
    judged = assess(content)
    assert judged.level == "not followed"
    assert f"rmse {content.fans[0].rmse_in_sigma:.2f} times the declared sigma" in judged.headline
    assert any("on average slower than the twin" in line for line in judged.warnings)
    assert "train it on them" in Page(report_page(content)).text


def test_what_limits_the_figures_is_a_warning(twin):
    run = published_run(7, 20.0)
    trained_on = DataCard("healthy.mcap", twin.card.training.data[0].sha256, 1, run.samples)
    seldom, wrong_unit = run.speed_rad_s.copy(), run.speed_rad_s * 60.0 / (2.0 * np.pi)
    seldom[::4] = np.nan
    content = content_of(twin, run)
    (fan,) = content.fans
    lost = replace(fan.figures, rmse_rad_s=np.inf, max_error_rad_s=np.inf, r2=-np.inf)
    healthy = replace(twin.card.healthy, independent_samples=(8.0,))
    of_few: Any = SimpleNamespace(card=replace(twin.card, healthy=healthy), path=twin.path)
    for judged, words in (
        (report_content(twin, [run], [trained_on], RAD_S), "used in training, so these figures are too favourable"),
        (content_of(twin, Run("beyond", run.t_s, run.command + 40.0, run.speed_rad_s)), "outside the trained range"),
        (content_of(twin, with_speed(run, seldom)), "speeds are missing"),
        (
            content_of(twin, with_speed(run, wrong_unit)),
            r"^Speeds up to \d,\d{3} rad/s, the twin knows \d{3}: is the re",
        ),
        (replace(content, fans=(replace(fan, sigma_rad_s=2.0 * fan.sigma_rad_s),)), "sigma is over 1.5 times the st"),
        (content_of(twin, run.between(0.0, 0.9)), r"\d+ independent errors determine the rmse to 1\d% only"),
        (replace(content, twin=of_few), "equivalent of 8 independent errors: its sigma may be off by 25%"),
        (replace(content, fans=(replace(fan, figures=lost),)), "This fan: the free run diverges."),
    ):
        assert any(re.search(words, line) for line in assess(judged).warnings), words


def test_of_many_fans_the_worst_decides_and_is_named_and_the_worst_are_drawn(twin):
    healthy = published_run(9, 10.0, fans=MOST_FANS_DRAWN + 3)
    content = content_of(twin, with_speed(healthy, healthy.speed_rad_s * np.where(np.arange(15) == 13, 0.7, 1.0)))
    judged = assess(content)
    assert "does not follow fan 13: rmse" in judged.headline
    assert "A twin of one fan is used for 15: fans differ, and so may their errors." in judged.warnings
    drawn = drawn_fans(content.fans)
    assert len(drawn) == MOST_FANS_DRAWN and 13 in [fan.number for fan in drawn]
    left_out = [fan.rmse_in_sigma for fan in content.fans if fan not in drawn]
    assert max(left_out) <= min(fan.rmse_in_sigma for fan in drawn)


@given(spike=st.integers(0, 19_999), columns=st.integers(10, 500), missing=st.integers(0, 10_000))
def test_a_thinned_line_keeps_every_spike_and_breaks_where_nothing_was_measured(spike, columns, missing):
    t_s = np.arange(20_000) / 100.0
    values = np.sin(t_s)
    values[missing : missing + 6000] = np.nan
    values[spike] = 50.0
    kept = kept_samples(t_s, [values], columns)
    assert spike in kept
    assert np.isnan(values[kept]).any()
    assert len(kept) <= 2 * columns + 2 or len(kept) == len(t_s)
    assert np.all(np.diff(kept) > 0)


def test_gaps_stay_open_long_ones_are_shortened_and_recordings_follow_one_another():
    run = published_run(1, 30.0)
    t_s = run.t_s + np.where(run.t_s > 10.0, 3600.0, 0.0) + np.where(run.t_s > 20.0, 0.5, 0.0)
    pieces = Run("night", t_s, run.command, run.speed_rad_s).split_at_gaps()
    line = timeline(pieces)
    assert [gap.shortened for gap in line.gaps] == [True, False]
    assert [round(gap.lasted_s, 2) for gap in line.gaps] == [3600.01, 0.51]
    assert line.t_s[-1] < 1.2 * run.duration_s
    assert np.all(np.diff(line.t_s) > 0.0)
    assert not line.keeps_the_clock
    (drawn,) = broken_at(line.starts, np.arange(run.samples), run.speed_rad_s[:, 0])
    assert np.flatnonzero(np.isnan(drawn)).tolist() == [line.starts[1], line.starts[2] + 1]
    first, second = published_run(1, 10.0).rows(500, 1000), published_run(2, 10.0)
    both, alone = timeline([first, second]), timeline([first])
    assert [name for _, name in both.recordings] == ["published 1", "published 2"]
    assert (both.t_s[0], alone.t_s[0], alone.keeps_the_clock) == (0.0, 5.0, True)


def test_the_static_curve_is_where_torque_and_load_meet():
    hold = np.repeat([20.0, 80.0, 50.0], 1500)
    run = published_run(1, 45.0)
    parameters = np.zeros(len(PARAMETER_NAMES))
    parameters[:3] = PUBLISHED_PARAMETERS[:3]
    model, state = PhysicalModel(), PhysicalModel().state_layout.initial_state(np.zeros(1), hold[:1])
    speed, _ = model.advance(state, hold[:, None], np.full(len(hold), 0.01), parameters[None])
    held = Run("holds", run.t_s, hold, speed)
    curve = static_curve(model, parameters, [held], 0, 100.0, 180.0)
    viscous, drag = PUBLISHED_PARAMETERS[1:3]

    def load(speed_rad_s: np.ndarray) -> np.ndarray:
        return viscous * speed_rad_s + drag * speed_rad_s**2

    np.testing.assert_allclose(load(curve.twin[:, 1]), curve.twin[:, 0], rtol=1e-6)
    np.testing.assert_array_equal(curve.measured[:, 0], [20.0, 80.0, 50.0])
    np.testing.assert_allclose(load(curve.measured[:, 1]), curve.measured[:, 0], rtol=0.01)
    shaken = Run("never held", run.t_s, hold + np.sin(run.t_s), speed)
    assert len(static_curve(model, parameters, [shaken], 0, 100.0, 180.0).measured) == 0


def test_recordings_summed_one_by_one_give_the_figures_of_all_their_samples(twin):
    runs = [published_run(2, 10.0), published_run(3, 14.0)]
    extent = common_extent([extent_of([run]) for run in runs])
    first, second = (recording_sums(runs_of_twin(twin, [run]), extent) for run in runs)
    summary = summary_of(twin, first + second, extent, [], RAD_S)
    content = report_content(twin, runs, [], RAD_S)
    (fan,), (of_samples,) = summary.fans, content.fans
    assert fan.error_std_rad_s == pytest.approx(np.nanstd(of_samples.error_rad_s))
    assert astuple(fan.figures) == pytest.approx(astuple(of_samples.figures))
    assert fan.residual.ljung_box_p == pytest.approx(of_samples.residual.ljung_box_p)
    np.testing.assert_allclose(fan.residual.cross_correlation, of_samples.residual.cross_correlation, atol=1e-9)
    assert [part.middle_rad_s for part in fan.by_speed] == [part.middle_rad_s for part in of_samples.by_speed]
    assert assess(summary) == assess(content)


def test_in_a_browser_nothing_overflows_is_fetched_or_too_small_to_read(page_of_hybrid):
    width_px = 390
    seen = measured(page_of_hybrid, width_px)
    assert seen["needs"] <= seen["width"] <= width_px
    assert seen["fetched"] == []
    assert seen["background"] == "rgb(255, 255, 255)"
    assert [figure["title"] for figure in seen["figures"]] == TITLES_OF_HYBRID
    for figure in seen["figures"]:
        ((left, top, width, height),) = [svg["box"] for svg in figure["svgs"]]
        _, caption_top, _, caption_height = figure["caption"]
        assert width > 250
        assert height > 180
        assert left >= 0
        assert left + width <= seen["width"]
        assert top >= caption_top + caption_height
        assert SMALLEST_TEXT_UNITS * figure["svgs"][0]["px_per_unit"] > 8.5, figure["title"]
    for left, _, width, _ in seen["tables"]:
        assert left + width <= seen["width"]


def test_what_the_twin_knows_is_drawn_where_its_card_says_it(twin, content_of_hybrid, page_of_hybrid):
    assert twin.card.model_uncertainty is None
    content, page = content_of_hybrid, page_of_hybrid
    known = content.card.model_uncertainty
    assert known is not None
    assert figures.OUTSIDE in figures.what_is_known(content, content.fans[0], known)
    assert [title for title in TITLES_OF_HYBRID if title in page] == TITLES_OF_HYBRID
    assert page.count("<svg ") == len(TITLES_OF_HYBRID) + 1
    assert "What to record next: " in page or "more such data hardly reduce its error" in page


COMMANDS = np.linspace(0.0, 1.0, 11)
CURVE = StaticCurve((), np.column_stack((COMMANDS, 200.0 * COMMANDS)))
SPEEDS_RAD_S = tuple((200.0 * COMMANDS).tolist())


def known(**unknown: float) -> ModelUncertainty:
    """2 rad/s everywhere but at the point of row and column (speed and command), which training has not seen."""
    std = np.full((11, 11), 2.0)
    if unknown:
        std[int(unknown["speed"] / 20.0), round(unknown["command"] * 10)] = unknown["std"]
    return by_speed(SPEEDS_RAD_S, COMMANDS.tolist(), std.tolist(), 2.0)


def test_a_command_never_held_is_advised_first_then_a_step_and_nothing_that_would_tell_little() -> None:
    found = least_known(known(speed=140.0, command=0.7, std=9.0), CURVE, None)
    assert found is not None
    assert (found.command, found.speed_rad_s, found.std_rad_s, found.held) == (COMMANDS[7], SPEEDS_RAD_S[7], 9.0, True)
    found = least_known(known(speed=160.0, command=0.2, std=9.0), CURVE, None)
    assert found is not None
    assert (found.command, found.speed_rad_s, found.held) == (COMMANDS[2], SPEEDS_RAD_S[8], False)
    assert least_known(known(speed=140.0, command=0.7, std=2.9), CURVE, None) is None
    diverging = StaticCurve((), np.column_stack((COMMANDS, np.full(11, np.nan))))
    assert least_known(known(speed=140.0, command=0.7, std=9.0), diverging, None) is None


def test_with_a_drive_commands_on_its_plateau_are_its_end() -> None:
    """The fan turns at 40 rad/s at commands from 0.1 to 0.2, and the table knows the end only."""
    drive = DriveCard(turning_command=0.1, kick_s=0.5, rest_s=1.0, lowest_command=(0.2,))
    on_plateau = np.column_stack((COMMANDS, np.maximum(200.0 * COMMANDS, 40.0)))[1:]
    unknown = known(speed=40.0, command=0.1, std=9.0)
    assert least_known(unknown, StaticCurve((), on_plateau), drive) is None
    assert least_known(unknown, StaticCurve((), on_plateau), None) is not None
