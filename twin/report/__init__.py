"""A report on a twin: one HTML page that needs nothing else. Content, judged, becomes a page."""

from twin.report.content import Content, FanContent, SpeedUnit, report_content
from twin.report.page import report_page
from twin.report.verdict import Verdict, judge, level_of

__all__ = ["Content", "FanContent", "SpeedUnit", "Verdict", "judge", "level_of", "report_content", "report_page"]
