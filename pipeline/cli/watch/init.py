"""`fantwin init`: what fans are there, and a configuration that watches them."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import typer

from fantwin.pipeline.cli.options import DEFAULT_CONFIG, JsonOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.cli.progress import working
from fantwin.pipeline.cli.watch.next_step import next_commands
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.files import write_whole
from fantwin.pipeline.launch.this_host import load_for_any_host
from fantwin.pipeline.sources.found import Found, free_name
from fantwin.pipeline.sources.hwmon.config import ROOT
from fantwin.pipeline.sources.hwmon.discovery import discover_hwmon
from fantwin.pipeline.sources.ipmi.discovery import discover_ipmi
from fantwin.pipeline.sources.logs.discovery import discover_logs
from fantwin.pipeline.sources.prometheus.discovery import discover_metrics
from fantwin.pipeline.sources.redfish.discovery import discover_controllers
from fantwin.pipeline.sources.serial.discovery import discover_device, serial_ports
from fantwin.pipeline.sources.snmp.discovery import discover_snmp

_BY_URL = {
    "redfish": discover_controllers,
    "ipmi": discover_ipmi,
    "snmp": discover_snmp,
    "prometheus": discover_metrics,
}


@dataclass(frozen=True)
class Chosen:
    """What is to be watched.

    Attributes:
        hwmon: the fans of this computer.
        writable: fantwin may command them.
        serial: ports.
        urls: addresses of controllers and servers, by kind of source.
        password_file: of the user in these addresses.
        logs: a folder of logs or tables; None: none.
    """

    hwmon: bool = False
    writable: bool = False
    serial: tuple[str, ...] = ()
    urls: Mapping[str, Sequence[str]] = field(default_factory=dict[str, Sequence[str]])
    password_file: Path | None = None
    logs: Path | None = None


def init(
    config: Annotated[
        Path, typer.Option("-c", "--config", metavar="FILE", help="The configuration to write; it must not exist.")
    ] = DEFAULT_CONFIG,
    hwmon: Annotated[bool, typer.Option("--hwmon", help="Watch the fans of this computer (Linux hwmon).")] = False,
    writable: Annotated[
        bool, typer.Option("--writable", help="Let fantwin command these fans, which a sweep needs.")
    ] = False,
    root: Annotated[Path, typer.Option(help="Folder of the hwmon chips.")] = ROOT,
    serial: Annotated[
        list[str] | None,
        typer.Option(metavar="PORT", help="Watch the fans of the device at this serial port. Repeatable."),
    ] = None,
    redfish: Annotated[
        list[str] | None,
        typer.Option(
            metavar="URL",
            help="Watch the fans of a server by its controller: https://USER@HOST, or of a range: "
            "https://bmc[001-400]. Repeatable.",
        ),
    ] = None,
    prometheus: Annotated[
        list[str] | None,
        typer.Option(metavar="URL", help="Watch the fans in a Prometheus, or of an exporter: URL/metrics. Repeatable."),
    ] = None,
    ipmi: Annotated[
        list[str] | None,
        typer.Option(metavar="URL", help="The same by IPMI: ipmi://USER@HOST, ipmi://localhost. Repeatable."),
    ] = None,
    snmp: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST", help="By SNMP: HOST with a file of its community, or USER@HOST. Repeatable."),
    ] = None,
    password_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File with the password of that user in its first line; or a folder of such files: HOST, or "
            "`default`.",
        ),
    ] = None,
    logs: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Say how the logs or tables in this folder are read.")
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Find fans, write a configuration that watches them, and say the next command.

    On a terminal it asks, unless options say what to watch. It writes nothing to a device; it listens to a serial port.

    Exit code 1 if there is no fan to watch, or the file exists.

    Example: fantwin init

    Example: fantwin init --hwmon --writable

    Example: fantwin init --redfish "https://ann@bmc[001-400].hall" --password-file bmc.secret
    """
    root = root.absolute() if root != ROOT else root
    urls = {"redfish": redfish, "ipmi": ipmi, "snmp": snmp, "prometheus": prometheus}
    given = {kind: each for kind, each in urls.items() if each}
    chosen = Chosen(hwmon or writable, writable, tuple(serial or ()), given, password_file, logs)
    if chosen.password_file and not given:
        raise UsageError(f"--password-file is for {', '.join(f'--{kind}' for kind in urls)}: name an address")
    if chosen == Chosen():
        if json_output or not _is_terminal():
            options = (
                "--hwmon, --serial PORT, --redfish URL, --ipmi URL, --snmp HOST, --prometheus URL or --logs FOLDER"
            )
            raise UsageError(f"say what to watch: {options}; {_seen(root)}")
        chosen = _asked(root)
    found_logs = discover_logs(chosen.logs) if chosen.logs else []
    found = list(_discovered(chosen, root, config.parent))
    trays = [each for each in found if each.tray]
    left_out = [f"{each.title}: {line}" for each in found if not each.tray for line in each.missing]
    if not trays and not found_logs:
        raise UserError(f"no fan to watch: {'; '.join(left_out) or 'nothing was chosen'}")
    if trays and config.exists():
        raise UserError(f"{config}: exists and was not changed: name another file with -c, or remove it")
    if trays:
        write_whole(config, "\n".join(['site = "site"\n', *(each.toml for each in trays)]).encode(), "; choose with -c")
    following = [command for command, _ in next_commands(load_for_any_host(config, stages=()))] if trays else []
    following += [each.next_command for each in found_logs]
    lines = [
        *(f"{each.title}: {line}" for each in trays for line in (*each.notes, *each.missing)),
        *(f"left out: {line}" for line in left_out),
        *(f"{config}: written, {_called(each)}, fans {each.fans}" for each in trays),
        *(f"{chosen.logs}: {each.format}, {len(each.files)} files" for each in found_logs),
        *(f"next: {line}" for line in following),
    ]
    written = str(config) if trays else None
    result = {"written": written, "next": following, "found": [asdict(each) | {"toml": each.toml} for each in found]}
    show(result | {"logs": [asdict(each) for each in found_logs]}, *lines, json_output=json_output)


def _discovered(chosen: Chosen, root: Path, folder: Path) -> Iterator[Found]:
    """What is there of the chosen, with names that differ."""
    names: set[str] = set()
    with working("reading the devices"):
        found = [*discover_hwmon(root, writable=chosen.writable)] if chosen.hwmon else []
        found += [discover_device(port) for port in chosen.serial]
        for kind, urls in chosen.urls.items():
            for url in urls:
                found += _BY_URL[kind](url, chosen.password_file, folder)
    for each in found:
        is_one = each.tray and "hosts" not in each.tray
        yield replace(each, tray={**each.tray, "name": free_name(each.tray["name"], names)}) if is_one else each


def _called(found: Found) -> str:
    return f"trays of {found.title}" if "hosts" in found.tray else f"tray {found.tray['name']}"


def _is_terminal() -> bool:
    return sys.stdin.isatty()


def _seen(root: Path) -> str:
    chips = [each.title for each in discover_hwmon(root) if each.tray]
    return f"here: {', '.join([*chips, *serial_ports()[0]]) or 'no hwmon chip with fans, no serial device'}"


def _asked(root: Path) -> Chosen:
    """What a person wants to watch."""
    chips = [each for each in discover_hwmon(root) if each.tray]
    ports, others = serial_ports()
    hwmon = writable = False
    for each in chips:
        typer.echo(f"{each.title}: {'; '.join(each.notes[: each.fans])}")
    if chips:
        hwmon = typer.confirm("Watch these fans of this computer?", default=True)
    if hwmon:
        why = "With commands, a twin takes minutes; without, it waits until the board has moved the fans enough."
        typer.echo(f"May fantwin command them? {why}")
        writable = typer.confirm("Command them?", default=False)
    serial = [port for port, device in ports.items() if typer.confirm(f"Watch {port} ({device})?", default=True)]
    if (
        others
        and not serial
        and (port := typer.prompt(f"Serial port ({', '.join(others)}), or Enter", default="", show_default=False))
    ):
        serial.append(port)
    url = typer.prompt("Controller of a server (Redfish), https://USER@HOST, or Enter", default="", show_default=False)
    asks_password = "@" in url
    password = typer.prompt("File with its password, readable by you alone") if asks_password else ""
    logs = typer.prompt("Folder of logs or tables, or Enter", default="", show_default=False)
    return Chosen(
        hwmon,
        writable,
        tuple(serial),
        {"redfish": (url,)} if url else {},
        Path(password) if password else None,
        Path(logs) if logs else None,
    )
