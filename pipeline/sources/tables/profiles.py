"""Programs whose tables and metrics are known, a row each: how they are recognised, and which columns are fans.

A new program is a row. The columns of a fan are found by `(?P<fan>...)` in their names, which must be the same in the
command and the speed; a pattern without it is of all fans.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from fantwin.pipeline.sources.column_file import ColumnFile
from fantwin.pipeline.sources.tables.fan_columns import FanColumns
from fantwin.pipeline.sources.tables.units import ELECTRICAL, ELECTRICAL_HUNDREDS


@dataclass(frozen=True)
class Profile:
    """A row.

    Attributes:
        title: the program that writes such files.
        head: patterns, each of which some name matches as a whole.
        about: keys before the names, with a pattern of their values.
        command, speed: patterns of the names of such columns; of several of a fan, that of the first pattern counts.
        unit: of speeds, where the names do not have it.
        time: patterns of the time columns, `DATE+TIME` in two. time_unit: of numbers in them.
        dates: order of the parts of a date.
        channels: patterns, by the name of their channel. units: of such columns, by name, where it does not have them.
        note: what a user has to know.
    """

    title: str
    head: tuple[str, ...]
    command: tuple[str, ...] = ()
    speed: tuple[str, ...] = ()
    about: Mapping[str, str] = field(default_factory=dict[str, str])
    unit: str = ""
    time: tuple[str, ...] = ()
    time_unit: str = ""
    dates: str = ""
    channels: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    units: Mapping[str, str] = field(default_factory=dict[str, str])
    note: str = ""

    def is_of(self, file: ColumnFile) -> bool:
        """Whether this program wrote the file."""
        return all(any(re.fullmatch(each, name) for name in file.names) for each in self.head) and all(
            re.fullmatch(value, file.about.get(key, "")) for key, value in self.about.items()
        )

    def time_in(self, names: Sequence[str]) -> str:
        """The time columns of a table, as `--time` takes them; empty: it has none of those known."""
        found = [next((name for name in names if re.fullmatch(each, name)), "") for each in self.time]
        unit = f":{self.time_unit}" if self.time_unit else ""
        return f"{'+'.join(found)}{unit}" if found and all(found) else ""

    def fans_in(self, file: ColumnFile) -> FanColumns:
        """The columns of command and speed that belong together, and those of the channels that all fans share."""
        commands, speeds = _by_fan(self.command, file.names), _by_fan(self.speed, file.names)
        shared = commands.get("", "") if len(commands) == 1 else ""
        pairs = [(command, name) for fan, name in speeds.items() if (command := commands.get(fan, shared))]
        channels = {channel: _by_fan(patterns, file.names).get("") for channel, patterns in self.channels.items()}
        labels = [
            file.labels.get(speed)
            or file.labels.get(command)
            or ("" if _NUMBERED.search(speed) else _UNIT.sub("", speed))
            for command, speed in pairs
        ]
        return FanColumns(
            command=tuple(command for command, _ in pairs),
            speed=tuple(speed for _, speed in pairs),
            others={channel: (name,) * len(pairs) for channel, name in channels.items() if name},
            is_found=True,
            labels=tuple(labels),
        )

    def speeds_in(self, file: ColumnFile) -> list[str]:
        """All columns of speeds."""
        return [name for name in file.names if any(re.fullmatch(each, name) for each in self.speed)]

    def unit_of(self, speeds: Sequence[str], given: str) -> tuple[str, list[str]]:
        """The unit of these speeds, if the user or the file gives this one, and a note on it."""
        if not self.unit or not all(any(re.fullmatch(each, name) for each in self.speed) for name in speeds):
            return given, []
        if not given:
            return self.unit, [f"speeds in {self.unit}, as usual for {self.title}"]
        if self.unit == ELECTRICAL_HUNDREDS and given == ELECTRICAL:
            return self.unit, [f"{speeds[0]} of {self.title} is in hundreds: multiplied by 100"]
        if self.unit != given:
            return given, [f"{speeds[0]} of {self.title} is usually in {self.unit}, not {given}: check the speeds"]
        return given, []


_UNIT = re.compile(r"\s*[\[(](?:RPM|rpm)[\])]$")
_NUMBERED = re.compile(r"\[\d+\]")
"""number in the name of a fan that is called by it"""
_DEBUG = (r"debug\[(?P<fan>\d+)\]",)
_POLES = "electrical revolutions: add --poles with the magnetic poles of the motors"
_BLACKBOX = Profile(
    "blackbox without speeds",
    head=(r"motor\[0\]", r"time(?: \(us\))?"),
    time=(r"time(?: \(us\))?",),
    time_unit="us",
    command=(r"motor\[(?P<fan>\d+)\]",),
    channels={"supply_voltage_v": (r"vbatLatest \(V\)", r"vbatLatest"), "current_a": (r"amperageLatest \(A\)",)},
    units={"vbatLatest": "V/100"},
    note="no speeds in it: switch on bidirectional DShot, or debug_mode RPM_FILTER, before the flight",
)
_OF_TOPIC = r"(?:(?P<before>.*/)?{}\.)?"
"""topic before the name of a field in a log; a table of one topic has none"""
_MOTORS, _OUTPUTS, _ESCS = map(_OF_TOPIC.format, ("actuator_motors", "actuator_outputs", "esc_status"))
PROFILES = (
    Profile(
        "HWiNFO",
        head=("Date", "Time", r".+\[(RPM|°C|V|W|MHz|%)\]"),
        time=("Date", "Time"),
        command=(r"(?P<fan>.+?)(?: Fan)? (?:PWM|Duty|Control) \[%\]", r"(?P<fan>.+) \[%\]"),
        speed=(r"(?P<fan>.+) \[RPM\]",),
        unit="rpm",
    ),
    Profile(
        "LibreHardwareMonitor or Open Hardware Monitor",
        head=("Time", r"/.+/(fan|control|temperature|voltage|load|clock)/\d+"),
        time=("Time",),
        dates="mdy",
        command=(r"(?P<fan>/.+)/control/(?P<number>\d+)",),
        speed=(r"(?P<fan>/.+)/fan/(?P<number>\d+)",),
        unit="rpm",
    ),
    replace(
        _BLACKBOX,
        title="Betaflight blackbox with debug_mode RPM_FILTER",
        about={"debug_mode": r"46|RPM_FILTER"},
        speed=_DEBUG,
        unit="hz",
        note="",
    ),
    replace(
        _BLACKBOX,
        title="Betaflight blackbox with debug_mode DSHOT_RPM_TELEMETRY",
        about={"debug_mode": r"45|DSHOT_RPM_TELEMETRY"},
        speed=_DEBUG,
        unit=ELECTRICAL_HUNDREDS,
        note=_POLES,
    ),
    replace(
        _BLACKBOX,
        title="Betaflight blackbox",
        head=(*_BLACKBOX.head, r"eRPM(\(/100\))?\[0\]"),
        speed=(r"eRPM(?:\(/100\))?\[(?P<fan>\d+)\]",),
        unit=ELECTRICAL_HUNDREDS,
        note=_POLES,
    ),
    replace(
        _BLACKBOX,
        title="INAV blackbox",
        head=(*_BLACKBOX.head, "escRPM"),
        note="escRPM is the mean of all motors, so no column is the speed of one motor",
    ),
    _BLACKBOX,
    Profile(
        "RCbenchmark",
        head=(r"Time \(s\)", r"(ESC.*|Throttle.*) \(.s\)", r"Motor (Electrical|Optical) Speed.* \((RPM|rad/s|Hz)\)"),
        time=(r"Time \(s\)",),
        command=(r"(?:ESC signal|ESC|ESC throttle|Throttle)(?: (?P<fan>[AB12]))? \([µμu]s\)",),
        speed=(
            r"Motor Electrical Speed(?: (?P<fan>[AB12]))? \((?:RPM|rad/s|Hz)\)",
            r"Motor Optical Speed(?: (?P<fan>[AB12]))? \((?:RPM|rad/s|Hz)\)",
        ),
        channels={"supply_voltage_v": (r"Voltage \(V\)",), "current_a": (r"Current \(A\)",)},
    ),
    Profile(
        "PX4",
        head=(rf"(?:{_MOTORS}control|{_OUTPUTS}output)\[0\]".replace("?P<before>", "?:"), rf"{_ESCS}esc\[0\]\.esc_rpm"),
        command=(rf"{_MOTORS}control\[(?P<fan>\d+)\]", rf"{_OUTPUTS}output\[(?P<fan>\d+)\]"),
        speed=(rf"{_ESCS}esc\[(?P<fan>\d+)\]\.esc_rpm",),
        unit="rpm",
    ),
    Profile(
        "MAVROS",
        head=(r".*mavros/rc/out\.channels\[0\]", r".*mavros/esc_status\.esc_status\[0\]\.rpm"),
        command=(r"(?P<before>.*)mavros/rc/out\.channels\[(?P<fan>\d+)\]",),
        speed=(r"(?P<before>.*)mavros/esc_status\.esc_status\[(?P<fan>\d+)\]\.rpm",),
        unit="rpm",
    ),
    Profile(
        "ArduPilot (mavlogdump)",
        head=(r"RPM(\{\d+\})?", r"C1"),
        unit="rpm",
        speed=(r"RPM(?:\{\d+\})?",),
        note="name them: ESC 0 is RPM{0}, output 1 is C1, and SERVOn_FUNCTION says which output drives which motor",
    ),
    Profile(
        "PX4, one topic",
        head=("timestamp", r"output\[0\]|control\[0\]|esc\[0\]\.esc_rpm"),
        time=("timestamp",),
        time_unit="us",
        note="commands and speeds are in two files: name both",
    ),
    Profile(
        "fan2go",
        head=(r"fan2go_fan_rpm.*", r"fan2go_fan_pwm.*"),
        command=(r"fan2go_fan_pwm(?:\{(?P<fan>.*)\})?",),
        speed=(r"fan2go_fan_rpm(?:\{(?P<fan>.*)\})?",),
        unit="rpm",
    ),
    Profile(
        "node_exporter",
        head=(r"node_hwmon_fan_rpm.*",),
        command=(r"node_hwmon_pwm(?:\{(?P<fan>.*?)(?:sensor=)?(?:pwm(?P<number>\d+))?(?P<more>,.*)?\})?",),
        speed=(r"node_hwmon_fan_rpm(?:\{(?P<fan>.*?)(?:sensor=)?(?:fan(?P<number>\d+))?(?P<more>,.*)?\})?",),
        unit="rpm",
    ),
    Profile(
        "Telegraf",
        head=(r"(sensors\.)?fan_input.*",),
        command=(r"(?:sensors\.)?pwm_?(?:input)?(?:\{(?P<fan>.*?)(?:feature=)?(?:pwm(?P<number>\d+))?\})?",),
        speed=(r"(?:sensors\.)?fan_input(?:\{(?P<fan>.*?)(?:feature=)?(?:fan(?P<number>\d+))?\})?",),
        unit="rpm",
    ),
    Profile(
        "files named as in hwmon",
        head=(r"(?i).*\bfan_?\d+(_input|_rpm|_speed)?( .*)?",),
        command=(r"(?i)pwm_?(?P<fan>\d+)(?:_pct|_duty)?(?: [\[(].*[\])])?",),
        speed=(r"(?i)fan_?(?P<fan>\d+)(?:_input|_rpm|_speed)?(?: [\[(].*[\])])?",),
        unit="rpm",
    ),
)


def profile_of(file: ColumnFile) -> Profile | None:
    """The program that wrote a file, by its names; None: it is not known."""
    return next((each for each in PROFILES if each.is_of(file)), None)


def _by_fan(patterns: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Names that match, by their fan; empty for one of all fans."""
    found: dict[str, str] = {}
    for pattern in patterns:
        for name in names:
            if match := re.fullmatch(pattern, name):
                found.setdefault("|".join(filter(None, match.groups())).strip().lower(), name)
    return found
