"""Pictures of a view without a display: a headless Rerun viewer draws an .rrd file and returns a screenshot.

Needs a Vulkan driver; without a graphics card, Mesa's software driver works.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from PIL import Image
from rerun.chunk import Chunk, RrdReader
from rerun.experimental import View, ViewerClient

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.rerun.plot_places import FleetPlots
from fantwin.pipeline.outputs.rerun.rerun_layout import LayoutName, TrayLayout, wear_blueprint
from fantwin.pipeline.outputs.rerun.rerun_paths import DAYS, TIMELINE, WEAR, place_in
from fantwin.pipeline.outputs.rerun.rerun_sink import APPLICATION, LOOPBACK, rerun_program
from fantwin.pipeline.outputs.rerun.site_layout import SiteLayout
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S, SpeedUnit

SIZE = (1920, 1080)
TOP_BAR_SHARE = 0.035  # of the height; it stays, empty, when it is hidden
TIMEOUT_S = 60.0
POLL_S = 0.2
NOTICE_S = 6.0  # for about five seconds the viewer covers a corner of the window with a notice
_DRIVER_FOLDERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
_DRIVER_VARIABLES = ("VK_DRIVER_FILES", "VK_ICD_FILENAMES", "VK_ADD_DRIVER_FILES")


class PictureError(UserError):
    """A picture cannot be drawn; the message says why and what to do."""


@dataclass(frozen=True)
class Picture:
    """A PNG of the window, and the warnings of each view by name."""

    png: bytes
    reports: dict[str, list[str]]


@dataclass(frozen=True)
class _Rrd:
    """The contents of a view file.

    Attributes:
        trays: by name, with the fans that have been drawn.
        worn: the trays with wear; last_day_ns: time of its newest point, 0: there is none.
    """

    chunks: Sequence[Chunk]
    trays: dict[str, TrayLayout]
    first_ns: int
    last_ns: int
    worn: Sequence[str] = ()
    last_day_ns: int = 0


def has_vulkan_driver() -> bool:
    """Whether the headless viewer can draw here. Other systems than Linux have what it needs."""
    if sys.platform != "linux":
        return True
    named = [Path(path) for name in _DRIVER_VARIABLES for path in os.environ.get(name, "").split(":") if path]
    if named:
        return any(path.is_file() for path in named)
    return any(any(Path(folder).glob("*.json")) for folder in _DRIVER_FOLDERS)


def draw_picture(
    rrd: Path,
    *,
    tray: str | None = None,
    fans: Sequence[int] | None = None,
    at_s: float | None = None,
    window_s: float = 30.0,
    view: str | None = None,
    layout: LayoutName = "all",
) -> Picture:
    """Draw a view file written by the viewer stage.

    Args:
        rrd: the file.
        tray: which tray; may be left out where there is one. Without tray and fans, the plots of a fleet are drawn.
        fans: which fans, counted from 0; the first eight if not given.
        at_s: end of the picture, s after the first sample of the file; its last sample if not given.
        window_s: length of time shown, s.
        view: part of the name of the one view to draw, of several that of a speed; the whole window if not given.
        layout: which; `alarms` is of all fans that were in alarm, unless a tray is given.

    Raises:
        PictureError: no driver, no such file, tray, fan or view, or the viewer did not draw it in time.
    """
    contents = _read(rrd)
    blueprint = _blueprint(rrd, contents, layout, tray, fans, window_s)
    if not has_vulkan_driver():
        raise PictureError(
            "no Vulkan driver found, which the headless viewer needs: apt-get install mesa-vulkan-drivers"
        )
    end_ns = contents.last_ns
    if at_s is not None:
        end_ns = contents.first_ns + round(at_s * NS_PER_S)
        contents = _until(contents, end_ns)
    with _headless_viewer() as viewer:
        began_s = time.monotonic()
        recording = rr.RecordingStream(APPLICATION)
        recording.connect_grpc(viewer.url, default_blueprint=blueprint)
        recording.send_chunks(contents.chunks)
        recording.flush()
        _wait_until_loaded(viewer, TIMELINE, contents.last_ns)
        timeline = DAYS if layout == "wear" else TIMELINE
        if layout == "wear":
            _wait_until_loaded(viewer, DAYS, contents.last_day_ns)
            end_ns = contents.last_day_ns
        viewer.set_time(timeline, timestamp=np.datetime64(end_ns, "ns"), play_state="paused")
        state = viewer.get_state()
        chosen = None
        if view is not None:
            matching = sorted((shown for shown in state.views if view in shown.name), key=_speeds_first)
            chosen = matching[0].view_id if matching else None
            if chosen is None:
                names = ", ".join(sorted(repr(shown.name) for shown in state.views))
                raise PictureError(f"{rrd}: no view called {view!r}; there are {names}")
        if chosen is None:
            time.sleep(max(0.0, began_s + NOTICE_S - time.monotonic()))
        png = _stable_screenshot(viewer, chosen)
        reports = {shown.name: [str(report) for report in shown.reports] for shown in viewer.get_state().views}
        recording.disconnect()
    return Picture(png if chosen else _without_top_bar(png), reports)


def _read(rrd: Path) -> _Rrd:
    if not rrd.is_file():
        raise PictureError(f"{rrd}: no such file; make one: fantwin view RECORDING -o {rrd}")
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*no footer")
            chunks = list(RrdReader(rrd).stream())
    except (RuntimeError, ValueError, OSError) as error:
        raise PictureError(f"{rrd}: not a Rerun file: {error}") from error
    trays: dict[str, TrayLayout] = {}
    times: list[Array] = []
    auxiliary: set[tuple[str, str]] = set()
    alarmed: dict[tuple[str, int], None] = {}
    worn: dict[str, None] = {}
    last_day_ns = 0
    for chunk in chunks:
        path, batch = chunk.entity_path.strip("/"), chunk.to_record_batch()
        if path.endswith("/speed") and chunk.is_static:
            _add_fan(trays, path, batch.column("Measurements:names")[0].as_py()[0])
        elif chunk.is_static:
            continue
        elif path.endswith("/speed"):
            times.append(_times_ns(batch))
        elif path.endswith("/deviation"):
            alarmed[_fan_of(path)] = None
        elif path.startswith(f"{WEAR}/"):
            worn[path.split("/")[1]] = None
            last_day_ns = max(last_day_ns, int(_times_ns(batch, DAYS).max()))
        elif path.count("/") == 2:
            tray, column, _ = path.split("/")
            auxiliary.add((tray, column))
    if not times:
        raise PictureError(f"{rrd}: holds no speeds drawn by the viewer stage")
    all_times = np.concatenate(times)
    for name, layout in trays.items():
        beside = [column for column in CHANNELS if (name, column.name) in auxiliary]
        in_alarm = [fan for tray, fan in alarmed if tray == name]
        trays[name] = replace(layout, auxiliary=beside, alarmed=in_alarm)
    first_ns, last_ns = int(all_times.min()), int(all_times.max())
    return _Rrd(chunks, trays, first_ns, last_ns, tuple(worn), last_day_ns)


def _fan_of(path: str) -> tuple[str, int]:
    """Tray and fan of one of a fan's entities, `[place/]tray/fan_3/speed`."""
    *_, tray, fan, _ = path.split("/")
    return tray, int(fan.removeprefix("fan_"))


def _add_fan(trays: dict[str, TrayLayout], path: str, name: str) -> None:
    """Add the fan with this entity of its speed, `[place/]tray/fan_3/speed`, whose first series has this name."""
    (tray, number), place = _fan_of(path), place_in("/".join(path.split("/")[:-3]))
    unit: SpeedUnit = "rpm" if name.endswith("(rpm)") else "rad/s"
    known = trays.get(tray, TrayLayout(tray, [], unit, 0))
    places = dict(known.places)
    if place is not None:
        places[number] = [*places.get(number, ()), place]
    fans = sorted({*known.fans, number})
    trays[tray] = replace(known, fans=fans, all_fans=len(fans), places=places)


def _speeds_first(view: View) -> tuple[bool, str]:
    return "speed" not in view.name, view.name


def _until(contents: _Rrd, end_ns: int) -> _Rrd:
    """What is in a view up to a time: a log, and an axis that fits what it shows, would go beyond the cursor."""
    chunks: list[Chunk] = []
    for chunk in contents.chunks:
        batch = chunk.to_record_batch()
        if chunk.is_static or TIMELINE not in batch.schema.names:
            chunks.append(chunk)
            continue
        is_kept = _times_ns(batch) <= end_ns
        if is_kept.any():
            chunks += Chunk.from_record_batch(batch.filter(pa.array(is_kept)))
    return replace(contents, chunks=chunks, last_ns=min(end_ns, contents.last_ns))


def _times_ns(batch: pa.RecordBatch, timeline: str = TIMELINE) -> Array:
    return np.asarray(batch.column(timeline)).astype("datetime64[ns]").astype(np.int64)


def _blueprint(
    rrd: Path, contents: _Rrd, layout: LayoutName, tray: str | None, fans: Sequence[int] | None, window_s: float
) -> rrb.Blueprint:
    if layout == "wear":
        if not contents.worn or (tray is not None and tray not in contents.worn):
            of = f" of {tray}" if tray else ""
            raise PictureError(f"{rrd}: no wear{of}: a fan has its first point about an hour after it was commissioned")
        return wear_blueprint([tray] if tray else contents.worn, for_picture=True)
    if any(each.places for each in contents.trays.values()) and tray is None and fans is None:
        count = max(
            (place for each in contents.trays.values() for of in each.places.values() for place in of), default=0
        )
        site = SiteLayout((), window_s, FleetPlots((), count))
        return site.blueprint(layout, for_picture=True)
    if layout == "alarms" and tray is None and fans is None:
        trays = [*contents.trays.values()]
    else:
        trays = [_layout(rrd, contents, tray, fans)]
    if layout == "alarms" and not any(each.alarmed for each in trays):
        raise PictureError(f"{rrd}: no fan{f' of {tray}' if tray else ''} was in alarm")
    return SiteLayout(tuple(trays), window_s).blueprint(layout, for_picture=True)


def _layout(rrd: Path, contents: _Rrd, tray: str | None, fans: Sequence[int] | None) -> TrayLayout:
    if tray is None:
        if len(contents.trays) != 1:
            names = ", ".join(contents.trays) or "none, as no fan had a plot"
            raise PictureError(f"{rrd}: there are several trays; choose one with --tray: {names}")
        (tray,) = contents.trays
    if tray not in contents.trays:
        raise PictureError(f"{rrd}: no tray called {tray!r}; there are {', '.join(contents.trays)}")
    known = contents.trays[tray]
    for fan in fans or ():
        if fan not in known.fans:
            if known.places:
                drawn = ", ".join(map(str, known.fans))
                raise PictureError(f"{rrd}: no plot has shown fan {fan} of {tray}; those shown are {drawn}")
            raise PictureError(f"{rrd}: {tray} has no fan {fan}; it has fans {min(known.fans)} to {max(known.fans)}")
    return replace(known, fans=list(fans) if fans else known.fans[:8])


@contextmanager
def _headless_viewer(files: Sequence[Path] = ()) -> Iterator[ViewerClient]:
    """A new viewer on a free loopback port with these views and layouts, ended on exit."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port = probe.getsockname()[1]
    size = f"{SIZE[0]}x{SIZE[1]}"
    command = [rerun_program(), "--headless", "--bind", LOOPBACK, "--port", str(port), "--window-size", size]
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            [*command, "--hide-welcome-screen", "--expect-data-soon", *files],
            stdout=output,
            stderr=output,
            env={**os.environ, "RERUN_APP_ONLY": "true", "RUST_LOG": "error"},
        )
        try:
            yield _connect(process, port)
        except (ConnectionError, TimeoutError, RuntimeError) as error:
            output.seek(0)
            lines = output.read().decode(errors="replace").strip().splitlines()
            raise PictureError(
                f"the headless viewer failed: {error}; its output: {lines[-1] if lines else 'none'}"
            ) from error
        finally:
            process.terminate()
            process.wait()


def _connect(process: subprocess.Popen[bytes], port: int) -> ViewerClient:
    deadline = time.monotonic() + TIMEOUT_S
    while process.poll() is None and time.monotonic() < deadline:
        with socket.socket() as probe:
            if probe.connect_ex((LOOPBACK, port)) == 0:
                return ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
        time.sleep(POLL_S)
    raise ConnectionError("it did not start")


def _wait_until_loaded(viewer: ViewerClient, timeline: str, last_ns: int) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline:
        state = viewer.get_state()
        ends = [line.end for entry in state.recordings for line in entry.timelines if line.name == timeline]
        # Rerun reports times rounded to floating point.
        if state.views and any(end is not None and end >= last_ns - 1_000 for end in ends):
            return
        time.sleep(POLL_S)
    raise ConnectionError(f"it did not load the file in {TIMEOUT_S:.0f} s")


def _stable_screenshot(viewer: ViewerClient, view_id: str | None) -> bytes:
    """The first screenshot that equals the one before it. One that a busy machine draws too slowly is left out."""
    deadline = time.monotonic() + TIMEOUT_S
    before = b""
    while time.monotonic() < deadline:
        with suppress(TimeoutError):
            now = viewer.take_screenshot(view_id)
            if now == before:
                return now
            before = now
        time.sleep(POLL_S)
    raise ConnectionError(f"the picture still changed after {TIMEOUT_S:.0f} s")


def _without_top_bar(png: bytes) -> bytes:
    image = Image.open(BytesIO(png))
    cropped = image.crop((0, round(TOP_BAR_SHARE * image.height), image.width, image.height))
    out = BytesIO()
    cropped.save(out, "PNG", optimize=True)
    return out.getvalue()
