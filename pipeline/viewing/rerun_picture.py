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
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from PIL import Image
from rerun.chunk import Chunk, RrdReader
from rerun.experimental import ViewerClient

from pipeline.errors import UserError
from pipeline.viewing.rerun_fleet import CELLS, MAP, bounds_of, overview_tab
from pipeline.viewing.rerun_layout import TIMELINE, TrayLayout, blueprint, place_in, tray_tab
from pipeline.viewing.rerun_sink import APPLICATION, LOOPBACK, rerun_program
from schemas.auxiliary import AUXILIARY
from schemas.messages import Array
from schemas.units import NS_PER_S, SpeedUnit

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
        map_places: (n, 2) what is on the map of a fleet; None: it is no fleet.
    """

    chunks: Sequence[Chunk]
    trays: dict[str, TrayLayout]
    map_places: Array | None
    first_ns: int
    last_ns: int


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
) -> Picture:
    """Draw a view file written by the viewer stage.

    Args:
        rrd: the file.
        tray: which tray; may be left out where there is one. Without tray and fans, the overview of a fleet is drawn.
        fans: which fans, counted from 0; the first eight if not given.
        at_s: end of the picture, s after the first sample of the file; its last sample if not given.
        window_s: length of time shown, s.
        view: part of the name of the one view to draw; the whole window if not given.

    Raises:
        PictureError: no driver, no such file, tray, fan or view, or the viewer did not draw it in time.
    """
    contents = _read(rrd)
    tab = _tab(rrd, contents, tray, fans, window_s)
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
        recording.connect_grpc(viewer.url, default_blueprint=blueprint([tab], for_picture=True))
        recording.send_chunks(contents.chunks)
        recording.flush()
        _wait_until_loaded(viewer, contents.last_ns)
        viewer.set_time(TIMELINE, timestamp=np.datetime64(end_ns, "ns"), play_state="paused")
        state = viewer.get_state()
        chosen = None
        if view is not None:
            chosen = next((shown.view_id for shown in state.views if view in shown.name), None)
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
        raise PictureError(f"{rrd}: no such file; the viewer stage writes view.rrd into run_folder")
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*no footer")
            chunks = list(RrdReader(rrd).stream())
    except (RuntimeError, ValueError, OSError) as error:
        raise PictureError(f"{rrd}: not a Rerun file: {error}") from error
    trays: dict[str, TrayLayout] = {}
    on_map: list[Array] = []
    times: list[Array] = []
    auxiliary: set[tuple[str, str]] = set()
    for chunk in chunks:
        path = chunk.entity_path.strip("/")
        if path.endswith("/speed"):
            batch = chunk.to_record_batch()
            if chunk.is_static:
                _add_fan(trays, path, batch.column("Measurements:names")[0].as_py()[0])
            else:
                times.append(_times_ns(batch))
        elif path.startswith(MAP) and chunk.is_static and "Points2D:positions" in chunk.to_record_batch().schema.names:
            on_map.append(np.array(chunk.to_record_batch().column("Points2D:positions")[0].as_py()))
        elif path == CELLS:
            times.append(_times_ns(chunk.to_record_batch()))
        elif path.count("/") == 2:
            tray, column, _ = path.split("/")
            auxiliary.add((tray, column))
    if not times:
        raise PictureError(f"{rrd}: holds no speeds drawn by the viewer stage")
    all_times = np.concatenate(times)
    map_places = np.concatenate(on_map) if on_map else None
    for name, layout in trays.items():
        beside = [column for column in AUXILIARY if (name, column.name) in auxiliary]
        trays[name] = replace(layout, auxiliary=beside)
    return _Rrd(chunks, trays, map_places, int(all_times.min()), int(all_times.max()))


def _add_fan(trays: dict[str, TrayLayout], path: str, name: str) -> None:
    """Add the fan with this entity of its speed, `[place/]tray/fan_3/speed`, whose first series has this name."""
    *root, tray, fan, _ = path.split("/")
    number, place = int(fan.removeprefix("fan_")), place_in("/".join(root))
    unit: SpeedUnit = "rpm" if name.endswith("(rpm)") else "rad/s"
    known = trays.get(tray, TrayLayout(tray, [], unit))
    places = dict(known.places)
    if place is not None:
        places[number] = [*places.get(number, ()), place]
    trays[tray] = replace(known, fans=sorted({*known.fans, number}), places=places)


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


def _times_ns(batch: pa.RecordBatch) -> Array:
    return np.asarray(batch.column(TIMELINE)).astype("datetime64[ns]").astype(np.int64)


def _tab(rrd: Path, contents: _Rrd, tray: str | None, fans: Sequence[int] | None, window_s: float) -> rrb.Container:
    if contents.map_places is not None and tray is None and fans is None:
        return overview_tab(bounds_of(contents.map_places), window_s)
    return tray_tab(_layout(rrd, contents, tray, fans), window_s)


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
def _headless_viewer() -> Iterator[ViewerClient]:
    """A new viewer on a free loopback port, ended on exit."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port = probe.getsockname()[1]
    size = f"{SIZE[0]}x{SIZE[1]}"
    command = [rerun_program(), "--headless", "--bind", LOOPBACK, "--port", str(port), "--window-size", size]
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            [*command, "--hide-welcome-screen", "--expect-data-soon"],
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


def _wait_until_loaded(viewer: ViewerClient, last_ns: int) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline:
        state = viewer.get_state()
        ends = [line.end for entry in state.recordings for line in entry.timelines if line.name == TIMELINE]
        # Rerun reports times rounded to floating point.
        if state.views and any(end is not None and end >= last_ns - 1_000 for end in ends):
            return
        time.sleep(POLL_S)
    raise ConnectionError(f"it did not load the file in {TIMEOUT_S:.0f} s")


def _stable_screenshot(viewer: ViewerClient, view_id: str | None) -> bytes:
    """The first screenshot that equals the one before it."""
    deadline = time.monotonic() + TIMEOUT_S
    before = viewer.take_screenshot(view_id)
    while time.monotonic() < deadline:
        time.sleep(POLL_S)
        now = viewer.take_screenshot(view_id)
        if now == before:
            return now
        before = now
    raise ConnectionError(f"the picture still changed after {TIMEOUT_S:.0f} s")


def _without_top_bar(png: bytes) -> bytes:
    image = Image.open(BytesIO(png))
    cropped = image.crop((0, round(TOP_BAR_SHARE * image.height), image.width, image.height))
    out = BytesIO()
    cropped.save(out, "PNG", optimize=True)
    return out.getvalue()
