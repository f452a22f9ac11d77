"""What the operators' page costs a browser: all fans of a site, each with a new score every second.

`python -m bench.runtime.page_cost --fans 5000` prints, for a second of wall time, the milliseconds of the page's main
thread by kind, as Chromium counts them, and the longest time between two frames. Compare two runs on the same machine
at the same load; a frame takes 17 ms at least.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from playwright.sync_api import sync_playwright

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.web.config import GatewayConfig
from fantwin.pipeline.runtime.stage import Context, Core
from fantwin.pipeline.selftest.scratch_site import free_port
from fantwin.schemas.enums import FanState
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Score
from fantwin.schemas.topics import tray_key
from fantwin.stages.gateway import STAGE

SITE, FANS_OF_TRAY = "hall", 50
MEASURED_S, SETTLING_S = 20.0, 4.0
NOISE, CHANGING = 0.25, 0.0004
"""of each score, relative; share of the fans that become suspect, or normal, in a second"""
KINDS = ("ScriptDuration", "RecalcStyleDuration", "LayoutDuration", "TaskDuration")
LONGEST_GAP = """() => {
    let last = performance.now();
    window.longest = 0;
    const step = (now) => {
        window.longest = Math.max(window.longest, now - last);
        last = now;
        requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
}"""


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fans", type=int, default=5000)
    fans = parser.parse_args().fans
    trays = tuple(
        TrayConfig(name=f"tray{number}", fans=FANS_OF_TRAY, speed_unit="rpm") for number in range(fans // FANS_OF_TRAY)
    )
    stop, port = threading.Event(), free_port()
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder)
        core = STAGE.build(Context(SITE, trays, GatewayConfig(port=port), run, run, 0, producer="gateway-1")).core
        feeding = threading.Thread(target=_feed, args=(core, trays, stop))
        feeding.start()
        try:
            _measure(f"http://127.0.0.1:{port}/", fans)
        finally:
            stop.set()
            feeding.join()
            core.close()


def _feed(core: Core, trays: tuple[TrayConfig, ...], stop: threading.Event) -> None:
    random = np.random.default_rng(1)
    level = random.uniform(0.05, 0.5, (len(trays), 1, FANS_OF_TRAY))
    state = np.full(level.shape, FanState.NORMAL, np.uint8)
    shape = (1, FANS_OF_TRAY)
    speed, zero, valid = np.full(shape, 500.0, np.float32), np.zeros(shape, np.float32), np.ones(shape, np.bool_)
    for sequence in range(10_000):
        began_s = time.monotonic()
        changing = random.random(state.shape) < CHANGING
        state[changing] = np.where(state[changing] == FanState.NORMAL, FanState.SUSPECT, FanState.NORMAL)
        for number, tray in enumerate(trays):
            score = Score(
                header=Header("scorer-1", sequence, tray.name),
                fans=FANS_OF_TRAY,
                period_ns=10_000_000,
                t_ns=np.array([time.time_ns()]),
                command=speed,
                measured_speed_rad_s=speed,
                predicted_speed_rad_s=speed,
                band_variance=speed,
                state=state[number],
                valid=valid,
                invalid_reason=np.zeros(shape, np.uint8),
                torque_balance_command=zero,
                expected_residual_rad_s=zero,
                expected_balance_command=zero,
                score=np.abs(level[number] * (1.0 + NOISE * random.standard_normal(shape))).astype(np.float32),
                statistic=np.zeros(shape, np.uint8),
            )
            core.step(Envelope.of(tray_key(SITE, tray.name, "score"), score, 0))
        core.tick(time.time_ns())
        if stop.wait(max(0.0, began_s + 1.0 - time.monotonic())):
            return


def _measure(url: str, fans: int) -> None:
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=arguments)
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(url)
        page.wait_for_selector(".cell.normal")
        page.wait_for_timeout(1000 * SETTLING_S)
        counters = page.context.new_cdp_session(page)
        counters.send("Performance.enable")

        def counted() -> dict[str, float]:
            return {each["name"]: each["value"] for each in counters.send("Performance.getMetrics")["metrics"]}

        before = counted()
        page.evaluate(LONGEST_GAP)
        page.wait_for_timeout(1000 * MEASURED_S)
        longest_ms = page.evaluate("window.longest")
        after = counted()
        browser.close()
    wall_s = after["Timestamp"] - before["Timestamp"]
    shown = ", ".join(
        f"{kind.removesuffix('Duration')} {1000 * (after[kind] - before[kind]) / wall_s:.0f}" for kind in KINDS
    )
    print(
        f"{fans} fans, ms a second: {shown}; longest time between two frames {longest_ms:.0f} ms; "
        f"nodes {after['Nodes']:.0f}"
    )


if __name__ == "__main__":
    main()
