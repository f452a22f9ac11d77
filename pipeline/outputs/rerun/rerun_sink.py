"""The viewer's sink: a Rerun recording that goes to a file and to live viewers on this host."""

from __future__ import annotations

import importlib.util
import math
import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fcntl import ioctl
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from termios import FIONREAD

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.rerun.alarm_log import LogLine
from fantwin.pipeline.outputs.rerun.fleet_view import is_fleet
from fantwin.pipeline.outputs.rerun.rerun_bands import RerunBands
from fantwin.pipeline.outputs.rerun.rerun_layout import LayoutName, TrayLayout, log_styles, site_blueprint
from fantwin.pipeline.outputs.rerun.rerun_styles import ALARMS_PATH, TIMELINE
from fantwin.pipeline.outputs.rerun.rerun_wear import RerunWear, WearPoints
from fantwin.pipeline.runtime.stage import StageError
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.loopback import LOOPBACK, check_free
from fantwin.pipeline.site.trace import Trace
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.messages import Array

CLOSE_LIMIT_S = 5.0
FLUSH_LIMIT_S = 0.5
_PIECE_BYTES = 1 << 16


class ViewFile:
    """Copies what is written to `pipe` into a file until the other end is closed.

    Rerun writes into the pipe and this class writes to the disk: Rerun's own file sink stops for ever when the disk
    refuses a write, and every later flush then waits without end. When the disk refuses, the file ends there and
    everything later is discarded: a gap would make it unreadable.
    """

    def __init__(self, path: Path, limit_bytes: float = math.inf) -> None:
        """Open an existing file for writing; it ends before it exceeds the limit.

        Raises:
            OSError: the file cannot be opened.
        """
        self.problem = ""
        """why nothing is written any more; empty if all is well"""
        self._path = path
        self._room_bytes = limit_bytes
        self._file = path.open("r+b", buffering=0)
        self._read_end, self._write_end = os.pipe()
        self.pipe = Path(f"/dev/fd/{self._write_end}")
        """open it for writing, then call `release_pipe`"""
        self._between = threading.Lock()
        """held while a piece is neither in the pipe nor in the file"""
        self._thread = threading.Thread(target=self._copy, daemon=True)
        self._thread.start()

    def release_pipe(self) -> None:
        """The pipe has been opened by its writer: the file ends when the writer closes it."""
        os.close(self._write_end)

    def flush(self) -> None:
        """Wait until the system has what is in the pipe, at most FLUSH_LIMIT_S."""
        until_s = time.monotonic() + FLUSH_LIMIT_S
        while time.monotonic() < until_s:
            if self._between.acquire(timeout=FLUSH_LIMIT_S):
                left = int.from_bytes(ioctl(self._read_end, FIONREAD, bytes(4)), sys.byteorder)
                self._between.release()
                if not left:
                    return
            time.sleep(0.001)

    def close(self) -> None:
        """Wait until everything is written, at most CLOSE_LIMIT_S."""
        self._thread.join(CLOSE_LIMIT_S)
        if self._thread.is_alive():
            self._stop(f"not finished after {CLOSE_LIMIT_S:g} s")
        else:
            os.close(self._read_end)

    def _copy(self) -> None:
        piece = b"\0"
        with self._file:
            while piece:
                select.select([self._read_end], [], [])
                with self._between:
                    piece = os.read(self._read_end, _PIECE_BYTES)
                    self._write(piece)

    def _write(self, piece: bytes) -> None:
        self._room_bytes -= len(piece)
        if self._room_bytes < 0:
            self._stop("it has the largest size of a view", "`fantwin view` shows a recording")
        rest = memoryview(piece)
        while rest and not self.problem:
            try:
                rest = rest[self._file.write(rest) :]
            except OSError as error:
                self._stop(error.strerror or str(error))

    def _stop(self, reason: str, todo: str = "make room and restart the viewer") -> None:
        self.problem = self.problem or (
            f"{self._path}: the view is not written any more: {reason}; what is in the file can be opened; {todo}"
        )


APPLICATION = "fantwin"
MEMORY_LIMIT = "256MB"
"""history for viewers that join late, half an hour of the demo's eight fans; a recording has all of it"""
VIEWERS_LIMIT_S = 2.0
"""how long a flush may take; it is called twice a second and usually takes milliseconds"""
# Rerun's page server runs in a shell that ends with this process, even when it is killed: the pipe to its input closes.
_PAGE_SCRIPT = '"$@" >/dev/null 2>&1 & cat >/dev/null; kill $!'


@dataclass(frozen=True)
class ViewOptions:
    """Options of a view, with the defaults of `[viewer]`.

    Attributes:
        show: fans of a fleet that always have a plot.
        file_bytes: size at which the file ends; the viewer sets one.
        grpc_port: where data are served to viewers on this host; None: nowhere.
        web_port: where the page of the browser viewer is served; None: nowhere.
    """

    layout: LayoutName = "all"
    window_s: float = 30.0
    show: Sequence[Fan] = ()
    file_bytes: float = math.inf
    grpc_port: int | None = None
    web_port: int | None = None


def rerun_program() -> Path:
    """Path of Rerun's executable inside its package; the `rerun` on the path is a wrapper around it."""
    spec = importlib.util.find_spec("rerun_cli")
    assert spec is not None and spec.origin is not None, "rerun-sdk contains rerun_cli"
    folder = Path(spec.origin).parent
    return folder / "Rerun.app/Contents/MacOS/Rerun" if sys.platform == "darwin" else folder / "rerun"


def _open_view(file: Path, limit_bytes: float) -> ViewFile:
    """Begin the file, or the first of file-2, file-3 ... that does not exist.

    Raises:
        StageError: it cannot be written.
    """
    path, number = file, 1
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while path.exists():
            number += 1
            path = file.with_stem(f"{file.stem}-{number}")
        path.open("xb").close()
        return ViewFile(path, limit_bytes)
    except OSError as error:
        raise StageError(f"{path}: cannot write the view: {error.strerror}; change viewer.file") from error


class RerunSink:
    """A Rerun recording, written to a file and served to viewers."""

    def __init__(
        self, name: str, trays: Sequence[TrayConfig], started_t_ns: int, file: Path | None, options: ViewOptions
    ) -> None:
        """Open `file`, and serve what the options name; None leaves the file out. Of a fleet, only the fans that
        `show_fans` names are shown.

        Raises:
            StageError: the file cannot be written, or a port is taken.
        """
        grpc_port, web_port = options.grpc_port, options.web_port
        for what, port in (("viewer.grpc_port", grpc_port), ("the page of viewer.grpc_port", web_port)):
            if port is not None:
                check_free(port, what, "viewer.grpc_port = 0")
        self._recording = rr.RecordingStream(APPLICATION)
        self._bands = RerunBands(self._recording)
        self._is_fleet = is_fleet(trays)
        self._trays = {
            each.name: TrayLayout(each.name, each.fans, each.speed_unit, self._is_fleet, names=each.names)
            for each in trays
        }
        self._styled: set[Fan] = set()
        self._options = options
        self._wear = RerunWear(self._recording)
        self._late = False
        self._file = _open_view(file, options.file_bytes) if file is not None else None
        sinks: list[rr.FileSink | rr.GrpcServerSink] = []
        if self._file is not None:
            # Without a footer, memory does not grow with the file, and the file can be opened after a crash.
            sinks.append(rr.FileSink(self._file.pipe, write_footer=False))
        if grpc_port is not None:
            server = rr.GrpcServerSink(LOOPBACK, grpc_port, server_memory_limit=MEMORY_LIMIT)
            sinks.append(server)
        self._recording.set_sinks(*sinks, default_blueprint=self._blueprint())
        if self._file is not None:
            self._file.release_pipe()
        self._recording.send_recording_name(f"{name} {np.datetime64(started_t_ns, 'ns').astype('datetime64[s]')} UTC")
        if not self._is_fleet:
            self._style([Fan(each.name, number) for each in trays for number in range(each.fans)])
        self.flush()  # the styles reach the file first, so that the file of a killed viewer has them
        self._page = _serve_page(web_port, grpc_port) if web_port is not None and grpc_port is not None else None

    def draw(self, trace: Trace) -> None:
        """Send the next stretch of a tray."""
        self._lay_out(trace)
        self._bands.draw(trace, self._trays[trace.tray].judged_together)

    def show_fans(self, fans: Sequence[Fan]) -> None:
        """Show these fans of a fleet, and no others, from now on."""
        self._style(fans)
        for name, tray in self._trays.items():
            drawn = [fan.number for fan in fans if fan.tray == name]
            if drawn or tray.alarmed:
                self._trays[name] = replace(tray, alarmed=drawn)
        self._recording.send_blueprint(self._blueprint())

    def _style(self, fans: Sequence[Fan]) -> None:
        new = [fan for fan in fans if fan not in self._styled]
        self._styled.update(new)
        for name in {fan.tray for fan in new}:
            log_styles(self._recording, self._trays[name], [fan.number for fan in new if fan.tray == name])

    def _lay_out(self, trace: Trace) -> None:
        """Give its plots to what a source measures beside command and speed, when it comes for the first time, and in
        the layout `alarms` to a fan that goes into alarm for the first time."""
        before = tray = self._trays[trace.tray]
        if not trace.auxiliary.keys() <= {column.name for column in tray.auxiliary}:
            shown = [each for each in CHANNELS if each in tray.auxiliary or each.name in trace.auxiliary]
            tray = replace(tray, auxiliary=shown)
        if self._options.layout == "alarms" and not self._is_fleet:
            in_alarm = [trace.fan_numbers[column] for column in np.flatnonzero(trace.in_alarm.any(axis=0)).tolist()]
            if new := [fan for fan in in_alarm if fan not in tray.alarmed]:
                tray = replace(tray, alarmed=(*tray.alarmed, *new))
        if tray is not before:
            self._trays[trace.tray] = tray
            self._recording.send_blueprint(self._blueprint())

    def _blueprint(self) -> rrb.Blueprint:
        return site_blueprint(self._options.layout, list(self._trays.values()), self._options.window_s)

    def draw_wear(self, tray: str, points: Sequence[WearPoints]) -> None:
        """Send the newest points of the wear of some fans."""
        self._wear.draw(tray, points, self._trays[tray].names)

    def show_alarms(self, table: str, t_ns: int) -> None:
        """Show the table of alarms from `t_ns` on."""
        self._recording.send_columns(
            ALARMS_PATH,
            [rr.TimeColumn(TIMELINE, timestamp=np.array([t_ns], "datetime64[ns]"))],
            rr.TextDocument.columns(text=[table], media_type=[rr.MediaType.MARKDOWN]),
        )

    def change_states(self, tray: str, fan: int, t_ns: Array, names: Sequence[str]) -> None:
        """Set the state of a fan's lane from each time on."""
        self._bands.change_states(tray, fan, self._trays[tray].names.name(fan), t_ns, names)

    def log(self, lines: Sequence[LogLine]) -> None:
        """Add lines to the log of their tray, or of the fleet, with their time of day (UTC)."""
        placed = [(self._trays[line.tray].log, line) for line in lines]
        for path, group in groupby(sorted(placed, key=itemgetter(0)), key=itemgetter(0)):
            of_log = [line for _, line in group]
            times = np.array([line.t_ns for line in of_log]).astype("datetime64[ns]")
            clocks = [text.split("T")[1] for text in np.datetime_as_string(times, unit="s").tolist()]
            trays = [f"{line.tray} " if self._is_fleet else "" for line in of_log]
            texts = [f"{clock}  {tray}{line.text}" for clock, tray, line in zip(clocks, trays, of_log, strict=True)]
            columns = rr.TextLog.columns(text=texts, level=[line.level for line in of_log])
            self._recording.send_columns(path, [rr.TimeColumn(TIMELINE, timestamp=times)], columns)

    def flush(self) -> None:
        """Pass everything on, so that it survives a crash of this process. Waits some seconds at most."""
        try:
            self._recording.flush(timeout_sec=VIEWERS_LIMIT_S)
        except RuntimeError:  # the only error it raises
            self._late = True
        else:
            self._late = False
        if self._file is not None:
            self._file.flush()

    def problem(self) -> str:
        """Why the view is not complete; empty if all is well."""
        late = f"live viewers take more than {VIEWERS_LIMIT_S:g} s for the newest data; close slow viewers"
        return "; ".join(filter(None, [self._file.problem if self._file else "", late if self._late else ""]))

    def close(self) -> None:
        """Write everything and stop serving, within some seconds."""
        self.flush()
        ending = threading.Thread(target=self._recording.disconnect, daemon=True)
        ending.start()
        ending.join(VIEWERS_LIMIT_S)
        if self._file is not None:
            self._file.close()
        if self._page is not None:
            assert self._page.stdin is not None
            self._page.stdin.close()
            try:
                self._page.wait(VIEWERS_LIMIT_S)
            except subprocess.TimeoutExpired:
                self._page.kill()


def _serve_page(web_port: int, grpc_port: int) -> subprocess.Popen[bytes]:
    """Serve the browser viewer's page on the loopback only; the call in Rerun's package listens on all interfaces."""
    data = f"rerun+http://{LOOPBACK}:{grpc_port}/proxy"
    page = [rerun_program(), "--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(web_port), data]
    # A separate session keeps Ctrl-C from the shell, which must end the server first.
    return subprocess.Popen(["sh", "-c", _PAGE_SCRIPT, "sh", *page], stdin=subprocess.PIPE, start_new_session=True)
