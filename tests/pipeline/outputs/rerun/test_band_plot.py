from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import matplotlib.image
import numpy as np
from matplotlib.colors import to_rgb
from typer.testing import CliRunner

from fantwin.pipeline.cli.main import app
from fantwin.pipeline.cli.recordings.view import view
from fantwin.pipeline.outputs.rerun import band_plot
from fantwin.pipeline.outputs.rerun.band_plot import Fault, plot_bands, read_trace
from fantwin.pipeline.site.trace import trace_of
from fantwin.schemas.messages import Alarm, Score
from tests.support.score_data import START_NS, made_up_tray
from tests.support.small_recordings import write

FAULT = Fault("covered-inlet", 2, START_NS + 8_000_000_000, START_NS + 14_000_000_000)


def test_the_band_is_green_and_red_zones_appear_only_during_an_alarm(tmp_path: Path) -> None:
    scores, _ = made_up_tray(fans=3)
    trace = trace_of("tray1", scores, "rad/s")
    share = {}
    for fan in (0, 2):
        plot_bands(trace, tmp_path / "bands.png", fans=[fan])
        share[fan] = {color: coverage(tmp_path / "bands.png", color) for color in (band_plot.BAND, ZONE_ON_WHITE)}
    assert share[0][band_plot.BAND] > 0.02 and share[2][band_plot.BAND] > 0.02
    assert share[2][ZONE_ON_WHITE] > 0.05
    assert share[0][ZONE_ON_WHITE] < 0.005  # its key in the legend


def test_what_was_measured_beside_has_a_panel_with_its_unit_below_each_fan() -> None:
    scores, _ = made_up_tray(fans=3)
    volts = [replace(score, supply_voltage_v=np.full(score.command.shape, 12.0, np.float32)) for score in scores]
    figure = band_plot._figure(trace_of("tray1", volts, "rpm"), [1, 2], [FAULT])
    assert [axes.get_ylabel() for axes in figure.axes] == ["speed (rpm)", "supply\n(V)", ""] * 2
    (line,) = figure.axes[1].lines
    assert np.nanmax(np.asarray(line.get_ydata(), float)) == 12.0
    unknown = [replace(score, supply_voltage_v=np.full(score.command.shape, np.nan, np.float32)) for score in scores]
    assert len(band_plot._figure(trace_of("tray1", unknown, "rpm"), [1, 2], [FAULT]).axes) == 4


def test_no_line_is_drawn_across_missing_samples() -> None:
    scores, _ = made_up_tray(fans=1, faulty_fan=None, gap_fan=None, block=10)
    del scores[100:110]
    trace = trace_of("tray1", scores, "rad/s")
    panel = band_plot._figure(trace, [0], []).axes[0]
    for line in panel.lines[:2]:
        y = np.asarray(line.get_ydata(), float)
        assert np.flatnonzero(np.isnan(y)).tolist() == [1000]


def test_a_recording_in_two_parts_is_one_trace_in_time_order_in_its_unit_of_speed(tmp_path: Path) -> None:
    scores, alarms = made_up_tray(seconds=4)
    second = record(tmp_path / "b.mcap", scores[20:], alarms)
    first = record(tmp_path / "a.mcap", scores[:20], [])
    trace, _ = read_trace([second, first], None, "rpm")
    whole = trace_of("tray1", scores, "rpm")
    assert trace.t_ns.tolist() == whole.t_ns.tolist()
    np.testing.assert_array_equal(trace.measured, whole.measured)
    for metadata in ({"speed_unit": "rpm"}, {"speed_unit.tray1": "rpm"}):
        path = record(tmp_path / "rec.mcap", scores, [], metadata)
        assert read_trace([path], None, None)[0].speed_unit == "rpm"
        assert read_trace([path], None, "rad/s")[0].speed_unit == "rad/s"


def test_the_command_plots_a_recording_with_its_true_faults(tmp_path: Path) -> None:
    scores, alarms = made_up_tray()
    recording = record(tmp_path / "rec.mcap", scores, alarms)
    truth = tmp_path / "truth.json"
    truth.write_text(json.dumps({"faults": [vars(FAULT)]}))
    app.command("view")(view)
    app.command("other")(lambda: None)
    output = tmp_path / "bands.png"
    arguments = ["view", str(recording), "-o", str(output), "--truth", str(truth), "--json"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    drawn = {"plot": str(output), "fans": [0, 2], "damage": []}
    assert json.loads(result.stdout) == drawn, "the fan with an alarm and a healthy one"
    assert coverage(output, band_plot.FAULT) > 0.001


ZONE_ON_WHITE = tuple(1 - 0.6 * (1 - part) for part in to_rgb(band_plot.ZONE))


def coverage(path: Path, color: str | tuple[float, ...]) -> float:
    """The share of a picture that has a colour."""
    pixels = matplotlib.image.imread(path)[..., :3]
    return float((np.abs(pixels - np.array(to_rgb(color))).max(axis=-1) < 0.02).mean())  # pyright: ignore[reportArgumentType]


def record(
    path: Path, scores: Sequence[Score], alarms: Sequence[Alarm], metadata: Mapping[str, str] = MappingProxyType({})
) -> Path:
    return write(path, [*scores, *alarms], {"site": "site", **metadata}, at=lambda message: int(np.max(message.t_ns)))
