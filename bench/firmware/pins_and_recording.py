"""A picture of a run of the firmware in its simulator: the pins (VCD) above, what was recorded of them below.

python -m bench.firmware.pins_and_recording PINS.vcd RECORDING.mcap --fan 2 -o PICTURE.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np

from fantwin.pipeline.recordings.reading import read_recording
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm, Prediction, Raw
from fantwin.schemas.units import NS_PER_S, RAD_S_PER_UNIT
from tests.support.fan_board import FANS
from tests.support.pin_trace import read_pin_trace

AT_THE_BLOCK_S = (-0.1, 0.45)
ON_PINS, RECORDED, TWIN, ALARM = "#1f7a3a", "#b26a00", "#0b5c8a", "#b3261e"
RPM = RAD_S_PER_UNIT["rpm"]


def draw(pins: Path, recording: Path, fan: int, output: Path) -> None:
    """Write the picture: from the first command of `fan` on, and the moment at which its rotor was blocked."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    trace = read_pin_trace(pins, FANS)
    messages = [envelope.message for envelope in read_recording(recording)]
    raws = [message for message in messages if isinstance(message, Raw)]
    clock_s = np.concatenate([raw.device_clock_us for raw in raws]) / 1e6
    received_s = np.concatenate([raw.host_receive_t_ns for raw in raws]) / NS_PER_S
    command, speed = (
        np.concatenate([getattr(raw, name) for raw in raws])[:, fan] for name in ("command", "speed_rad_s")
    )
    predictions = [message for message in messages if isinstance(message, Prediction)]
    predicted_s = np.concatenate([message.t_ns for message in predictions]) / NS_PER_S
    predicted = np.concatenate([message.predicted_speed_rad_s for message in predictions])[:, fan]
    raised = [m for m in messages if isinstance(m, Alarm) and m.transition == Transition.RAISED and m.fan == fan]
    blocked_s = trace.blocked_s[fan][0]
    alarm_s = np.interp([alarm.t_ns / NS_PER_S for alarm in raised[:1]], received_s, clock_s) - blocked_s

    figure, columns = plt.subplots(
        3, 2, sharey="row", figsize=(10, 5.4), height_ratios=(1, 1, 2.4), layout="constrained"
    )
    falling_s, end_s = trace.falling_s[fan], clock_s[-1]
    on_pins = trace.speed_rad_s(fan, falling_s)
    commanded_s = trace.duty_t_s[fan][1] - blocked_s if len(trace.duty_t_s[fan]) > 1 else -1.0
    windows_s = ((commanded_s - 1.0, 1.0), AT_THE_BLOCK_S)
    for (tacho, duty, shown), (begin_s, until_s) in zip(columns.T, windows_s, strict=True):
        tacho.vlines(falling_s - blocked_s, 0, 1, lw=0.5, color=ON_PINS)
        tacho.set(yticks=[])
        duty.step(
            np.append(trace.duty_t_s[fan], end_s) - blocked_s,
            np.append(trace.duty[fan], trace.duty[fan][-1]),
            where="post",
            color=ON_PINS,
            label="on the pin",
        )
        duty.plot(clock_s - blocked_s, command, ".", ms=3, color=RECORDED, label="recorded")
        shown.step(falling_s - blocked_s, on_pins / RPM, where="post", color=ON_PINS, label="from the edges on the pin")
        shown.plot(clock_s - blocked_s, speed / RPM, ".", ms=4, color=RECORDED, label="recorded")
        in_board_s = np.interp(predicted_s, received_s, clock_s, right=np.nan)
        shown.plot(in_board_s - blocked_s, predicted / RPM, color=TWIN, lw=1, label="twin")
        for axes in (tacho, duty, shown):
            axes.set_xlim(begin_s, until_s)
            axes.axvline(0.0, color="black", lw=0.8, ls=":")
        for at_s in alarm_s:
            shown.axvline(at_s, color=ALARM)
        shown.set_xlabel("seconds since the rotor was blocked")
    columns[0, 0].set(ylabel="tacho\nedges", title=f"fan {fan}, from a command on")
    columns[0, 1].set_title("at the block")
    columns[1, 0].set(ylabel="duty", ylim=(0, 1.08))
    columns[1, 0].legend(loc="lower left", ncols=2, fontsize=8)
    columns[2, 0].set(ylabel="speed, rpm", ylim=(0, None))
    columns[2, 0].legend(loc="lower left", fontsize=8)
    for at_s in alarm_s:
        columns[2, 1].annotate(
            f"alarm\n{at_s:.3f} s",
            (at_s, 0.55),
            xycoords=("data", "axes fraction"),
            xytext=(6, 0),
            textcoords="offset points",
            color=ALARM,
        )
    figure.savefig(output, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pins", type=Path)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--fan", type=int, default=2)
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args()
    draw(given.pins, given.recording, given.fan, given.output)


if __name__ == "__main__":
    main()
