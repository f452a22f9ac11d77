"""The viewer's sink: a Rerun recording that goes to a file and to live viewers on this host.

Each fan has one entity with its series side by side, and one `send_columns` per flush. Deviations in alarm, samples
outside the band and samples without a score are sent only if there are any.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np

os.environ.setdefault("RUST_LOG", "warn,re_log_encoding=error")  # otherwise every start warns of the missing footer
import rerun as rr

from pipeline.config.models import TrayConfig
from pipeline.runtime.stage import StageError
from pipeline.viewing.loopback import LOOPBACK, check_free
from pipeline.viewing.rerun_layout import (
    STAGES_PATH,
    TIMELINE,
    TrayLayout,
    blueprint,
    fan_path,
    log_path,
    log_styles,
    state_path,
)
from pipeline.viewing.trace import Trace
from pipeline.viewing.view_file import ViewFile
from schemas.messages import Array

APPLICATION = "fantwin"
FLUSH_LIMIT_S = 2.0
"""how long a flush may take; it is called twice a second and usually takes milliseconds"""
# Rerun's page server runs in a shell that ends with this process, even when it is killed: the pipe to its input closes.
_PAGE_SCRIPT = '"$@" >/dev/null 2>&1 & cat >/dev/null; kill $!'


def rerun_program() -> Path:
    """Path of Rerun's executable inside its package; the `rerun` on the path is a wrapper around it."""
    spec = importlib.util.find_spec("rerun_cli")
    assert spec is not None and spec.origin is not None, "rerun-sdk contains rerun_cli"
    folder = Path(spec.origin).parent
    return folder / "Rerun.app/Contents/MacOS/Rerun" if sys.platform == "darwin" else folder / "rerun"


def _open_view(file: Path) -> ViewFile:
    path = unused_path(file)
    try:
        return ViewFile(path)
    except OSError as error:
        raise StageError(f"{path}: cannot write the view: {error.strerror}; change viewer.file") from error


def unused_path(path: Path) -> Path:
    """Create and return `path`, or the first of path-2, path-3 ... that does not exist.

    Raises:
        StageError: the file cannot be created.
    """
    candidate, number = path, 1
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while candidate.exists():
            number += 1
            candidate = path.with_stem(f"{path.stem}-{number}")
        candidate.open("xb").close()
    except OSError as error:
        raise StageError(f"{candidate}: cannot write the view: {error.strerror}; change viewer.file") from error
    return candidate


class RerunSink:
    """A Rerun recording, written to a file and served to viewers."""

    def __init__(
        self,
        *,
        name: str,
        trays: Sequence[TrayConfig],
        started_t_ns: int,
        window_s: float,
        file: Path | None,
        grpc_port: int | None,
        web_port: int | None,
        memory_limit: str,
    ) -> None:
        """Open `file`, a data server at `grpc_port` and a page for browsers at `web_port`; None leaves one out.

        Raises:
            StageError: the file cannot be written, or a port is taken.
        """
        for key, port in (("grpc_port", grpc_port), ("web_port", web_port)):
            if port is not None:
                check_free(port, f"viewer.{key}", "viewer.serve = false")
        layouts = [TrayLayout(tray.name, range(tray.fans), tray.speed_unit) for tray in trays]
        self._recording = rr.RecordingStream(APPLICATION)
        self._open_paths: set[str] = set()
        self._late = False
        self._file = _open_view(file) if file is not None else None
        sinks: list[rr.FileSink | rr.GrpcServerSink] = []
        if self._file is not None:
            # Without a footer, memory does not grow with the file, and the file can be opened after a crash.
            sinks.append(rr.FileSink(self._file.pipe, write_footer=False))
        if grpc_port is not None:
            server = rr.GrpcServerSink(LOOPBACK, grpc_port, server_memory_limit=memory_limit)
            sinks.append(server)
        self._recording.set_sinks(*sinks, default_blueprint=blueprint(layouts, window_s))
        if self._file is not None:
            self._file.release_pipe()
        self._recording.send_recording_name(f"{name} {np.datetime64(started_t_ns, 'ns').astype('datetime64[s]')} UTC")
        for layout in layouts:
            log_styles(self._recording, layout)
        self.flush()  # the styles reach the file first, so that the file of a killed viewer has them
        self._page = _serve_page(web_port, grpc_port) if web_port is not None and grpc_port is not None else None

    def draw(self, trace: Trace) -> None:
        """Send the next stretch of a tray."""
        for fan in range(trace.fans):
            self._draw_fan(trace, fan)

    def change_states(self, tray: str, fan: int, t_ns: Array, names: Sequence[str]) -> None:
        """Set the state of a fan's lane from each time on."""
        self._send(state_path(tray, fan), t_ns, rr.StateChange.columns(state=list(names)))

    def log(self, tray: str, t_ns: int, level: str, text: str) -> None:
        """Add a line to the log of a tray, with its time of day (UTC)."""
        times = np.array([t_ns])
        clock = np.datetime_as_string(times.astype("datetime64[ns]"), unit="ms")[0].split("T")[1]
        self._send(log_path(tray), times, rr.TextLog.columns(text=[f"{clock}  {text}"], level=[level]))

    def show_stages(self, page: str) -> None:
        """Replace the page about the stages. It has no time and so does not move a cursor that follows the newest."""
        self._recording.log(STAGES_PATH, rr.TextDocument(page, media_type=rr.MediaType.MARKDOWN), static=True)

    def flush(self) -> None:
        """Pass everything on, so that it survives a crash of this process. Waits some seconds at most."""
        try:
            self._recording.flush(timeout_sec=FLUSH_LIMIT_S)
        except RuntimeError:  # the only error it raises
            self._late = True
        else:
            self._late = False
        if self._file is not None:
            self._file.flush()

    def problem(self) -> str:
        """Why the view is not complete; empty if all is well."""
        late = f"live viewers take more than {FLUSH_LIMIT_S:g} s for the newest data; close slow viewers"
        return "; ".join(filter(None, [self._file.problem if self._file else "", late if self._late else ""]))

    def close(self) -> None:
        """Write everything and stop serving, within some seconds."""
        self.flush()
        ending = threading.Thread(target=self._recording.disconnect, daemon=True)
        ending.start()
        ending.join(FLUSH_LIMIT_S)
        if self._file is not None:
            self._file.close()
        if self._page is not None:
            assert self._page.stdin is not None
            self._page.stdin.close()
            try:
                self._page.wait(FLUSH_LIMIT_S)
            except subprocess.TimeoutExpired:
                self._page.kill()

    def _draw_fan(self, trace: Trace, fan: int) -> None:
        measured, predicted, half_width = trace.measured[:, fan], trace.predicted[:, fan], trace.half_width[:, fan]
        scored = trace.valid[:, fan]
        ends = _ends_of_band(predicted, half_width)
        shown = np.stack([np.where(scored, measured, np.nan), predicted, *ends], axis=1)
        none = np.zeros_like(half_width)
        variances = np.stack([none, half_width**2, none, none], axis=1)
        self._send_measurements(fan_path(trace.tray, fan, "speed"), trace.t_ns, shown, variances)
        self._draw_deviation(trace, fan)
        outside = trace.outside[:, fan]
        if outside.any():
            columns = rr.Scalars.columns(scalars=measured[outside])
            self._send(fan_path(trace.tray, fan, "outside"), trace.t_ns[outside], columns)
        self._send_where(fan_path(trace.tray, fan, "not_scored"), trace.t_ns, np.where(scored, np.nan, measured))

    def _draw_deviation(self, trace: Trace, fan: int) -> None:
        """Send the red area between twin and measured speed while an alarm is active."""
        path = fan_path(trace.tray, fan, "deviation")
        measured, predicted = trace.measured[:, fan], trace.predicted[:, fan]
        middle = np.where(trace.in_alarm[:, fan], (measured + predicted) / 2, np.nan)
        if self._has_news(path, middle):
            self._send_measurements(path, trace.t_ns, middle[:, None], ((measured - predicted)[:, None] / 2) ** 2)

    def _send_where(self, path: str, t_ns: Array, values: Array) -> None:
        if self._has_news(path, values):
            self._send(path, t_ns, rr.Scalars.columns(scalars=values))

    def _has_news(self, path: str, values: Array) -> bool:
        """Whether there are values, or a NaN is needed to end the line or zone that is still open."""
        was_open = path in self._open_paths
        if np.isfinite(values[-1]):
            self._open_paths.add(path)
        else:
            self._open_paths.discard(path)
        return was_open or bool(np.isfinite(values).any())

    def _send_measurements(self, path: str, t_ns: Array, values: Array, variances: Array) -> None:
        columns = rr.Measurements.columns(values=values.reshape(-1), variances=variances.reshape(-1))
        self._send(path, t_ns, columns.partition([values.shape[1]] * len(values)))

    def _send(self, path: str, t_ns: Array, columns: rr.ComponentColumnList) -> None:
        time = rr.TimeColumn(TIMELINE, timestamp=t_ns.astype("datetime64[ns]"))
        self._recording.send_columns(path, indexes=[time], columns=columns)


def _ends_of_band(predicted: Array, half_width: Array) -> tuple[Array, Array]:
    """The lowest and the highest value (n,) of a stretch of the band, each where it lies; NaN elsewhere."""
    low, high = np.full_like(predicted, np.nan), np.full_like(predicted, np.nan)
    if np.isfinite(predicted).any():
        lowest, highest = np.nanargmin(predicted - half_width), np.nanargmax(predicted + half_width)
        low[lowest], high[highest] = (predicted - half_width)[lowest], (predicted + half_width)[highest]
    return low, high


def _serve_page(web_port: int, grpc_port: int) -> subprocess.Popen[bytes]:
    """Serve the browser viewer's page on the loopback only; the call in Rerun's package listens on all interfaces."""
    data = f"rerun+http://{LOOPBACK}:{grpc_port}/proxy"
    page = [rerun_program(), "--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(web_port), data]
    # A separate session keeps Ctrl-C from the shell, which must end the server first.
    return subprocess.Popen(["sh", "-c", _PAGE_SCRIPT, "sh", *page], stdin=subprocess.PIPE, start_new_session=True)
