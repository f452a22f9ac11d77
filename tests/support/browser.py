"""A page in a real browser, without a window: what it looks like there, measured by the browser itself."""

import html
import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")

MEASURE = """
<!DOCTYPE html><meta charset="utf-8"><body style="margin:0">
<iframe id="page" style="width:{width}px;height:900px;border:0" srcdoc="{page}"></iframe>
<pre id="measured"></pre>
<script>
document.getElementById("page").onload = event => {{
  const inside = event.target.contentWindow, root = inside.document.documentElement;
  const box = element => {{ const r = element.getBoundingClientRect(); return [r.left, r.top, r.width, r.height]; }};
  const shown = element => element.getClientRects().length > 0;
  const figures = [...inside.document.querySelectorAll("figure")].map(figure => ({{
    title: figure.querySelector("figcaption b").textContent,
    caption: box(figure.querySelector("figcaption")),
    svgs: [...figure.querySelectorAll("svg")].filter(shown).map(svg => ({{
      box: box(svg), px_per_unit: box(svg)[2] / svg.viewBox.baseVal.width
    }})),
  }}));
  const scrolls = [...inside.document.querySelectorAll("table")].map(table => box(table.parentElement));
  const needed = [...inside.document.querySelectorAll("table")].map(table => table.parentElement.scrollWidth);
  document.getElementById("measured").textContent = JSON.stringify({{
    width: root.clientWidth, needs: root.scrollWidth, figures, tables: scrolls, needed,
    fetched: inside.performance.getEntriesByType("resource").map(entry => entry.name),
    background: inside.getComputedStyle(inside.document.body).backgroundColor,
  }});
}};
</script>
"""


def browser() -> str:
    """The browser's path; skips the test where there is none."""
    for name in BROWSERS:
        if found := shutil.which(name):
            return found
    pytest.skip(f"no browser to look at the page with ({', '.join(BROWSERS)}); apt-get install chromium")


def seen_in_browser(page: str, width_px: int, folder: Path) -> dict[str, Any]:
    """Lay the page out at a width and measure it."""
    frame = folder / f"frame-{width_px}.html"
    frame.write_text(MEASURE.format(width=width_px, page=html.escape(page)), encoding="utf-8")
    arguments = ["--headless=new", "--disable-gpu", f"--user-data-dir={folder / 'profile'}", "--window-size=1600,1000"]
    if os.geteuid() == 0:
        arguments.append("--no-sandbox")  # the sandbox refuses to run as root
    command = [browser(), *arguments, "--virtual-time-budget=10000", "--dump-dom", frame.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    found = re.search(r'<pre id="measured">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found, done.stderr
    return json.loads(html.unescape(found[1]))
