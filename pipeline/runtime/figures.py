"""The figures in what stages say of themselves: two lines that differ only in them say the same."""

from __future__ import annotations

import re

_FIGURE = re.compile(r"\d[\d,]*\.\d+|\d[\d,]*(?= ?(?:B|kB|MB|GB|ms|s|min|h|%|rpm|rad/s|samples|messages|times)\b)")


def without_figures(line: str) -> str:
    """The line without its measured figures, which change while its meaning stays; numbers of fans are kept."""
    return _FIGURE.sub("#", line)
