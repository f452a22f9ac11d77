"""The files that make systemd run a site: one hardened unit, the rights that its sources need, its user."""

from __future__ import annotations

import grp
import os
import pwd
import re
import stat
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import metadata, resources
from pathlib import Path
from string import Template

from pydantic import BaseModel

from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.hwmon.config import ROOT, HwmonConfig
from fantwin.pipeline.sources.ipmi.config import HERE, IpmiConfig
from fantwin.pipeline.sources.modbus.config import ModbusConfig
from fantwin.pipeline.sources.serial.config import SerialConfig

USER = "fantwin"
"""the user of its own that a service has; its group may command fans"""
UNIT, ROUTER = "fantwin.service", "fantwin-router.service"
STATE_FOLDER = Path("/var/lib/fantwin")
UNITS, RULES, USERS = Path("etc/systemd/system"), Path("etc/udev/rules.d/60-fantwin.rules"), Path("etc/sysusers.d")
_HOMES = ("/home/", "/root/", "/run/user/")
_USB_PORTS = ("ttyUSB", "ttyACM")
_IPMI = "ipmidev"
"""devices of the driver by which a controller of this host is read, as /proc/devices names them"""
_IPMI_RULE = f'SUBSYSTEM=="ipmi", GROUP="{USER}", MODE="0660"\n'


@dataclass(frozen=True)
class Service:
    """A site as a service.

    Attributes:
        config: the configuration, an absolute path.
        run_folder: where it writes.
        program: the words that start `fantwin`.
        installation: folders that the program needs.
        read: folders of files that the configuration names.
        user: who runs it.
        group: the primary group of that user.
        chips: names of the hwmon chips whose fans it commands.
        ports: kinds of devices that it opens, such as ttyUSB; groups: those whose members may open them.
        written: other folders that it writes.
    """

    config: Path = Path("/etc/fantwin/fantwin.toml")
    run_folder: Path = STATE_FOLDER
    program: tuple[str, ...] = ("/opt/fantwin/bin/fantwin",)
    installation: tuple[Path, ...] = ()
    read: tuple[Path, ...] = ()
    user: str = USER
    group: str = USER
    chips: tuple[str, ...] = ()
    ports: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    written: tuple[Path, ...] = ()

    @classmethod
    def of(cls, config: Config, user: str) -> Service:
        """The service of a configuration with this installation of fantwin."""
        sources = [tray.source for tray in config.trays]
        commanded = [each for each in sources if isinstance(each, HwmonConfig) and each.writable]
        lines = [
            each.port for each in sources if isinstance(each, SerialConfig | ModbusConfig) and _is_device(each.port)
        ]
        ports = [kind for port in lines for kind in _kinds(port)]
        ports += [_IPMI for each in sources if isinstance(each, IpmiConfig) and each.url == HERE]
        group = grp.getgrgid(pwd.getpwnam(user).pw_gid).gr_name if user != USER else USER
        return cls(
            config=config.path.resolve(),
            run_folder=config.run_folder.resolve(),
            program=(sys.executable, "-P", "-m", "fantwin"),  # what is beside the configuration is not imported
            installation=tuple({Path(sys.prefix), Path(sys.base_prefix), Path(__file__).resolve().parents[3]}),
            read=tuple(sorted(_folders_read(config))),
            user=user,
            group=group,
            chips=tuple(dict.fromkeys(each.chip_name for each in commanded if each.root == ROOT)),
            ports=tuple(dict.fromkeys(ports)),
            groups=tuple(dict.fromkeys(map(_group_of, lines))),
            written=tuple(dict.fromkeys(each.root for each in commanded if each.root != ROOT)),
        )

    def files(self) -> dict[Path, str]:
        """What systemd and udev need, by path from the root of the system."""
        command = [*self.program, "up", "-c", str(self.config)]
        found = {UNITS / UNIT: self._unit("the fans of a site, and the operators' page", command, is_notifying=True)}
        found[USERS / "fantwin.conf"] = "".join(self._sysusers())
        rules = [*map(_rule, self.chips), *([_IPMI_RULE] if _IPMI in self.ports else [])]
        return found | ({RULES: "".join(rules)} if rules else {})

    def router(self, listen: str = "tls/0.0.0.0:7447") -> dict[Path, str]:
        """The unit of the router at which several hosts meet."""
        command = [*self.program, "router", "-c", str(self.config), "--listen", listen]
        alone = replace(self, chips=(), ports=(), groups=(), written=())
        return {UNITS / ROUTER: alone._unit("the router of a site", command, is_notifying=False)}

    def _unit(self, description: str, command: Sequence[str], *, is_notifying: bool) -> str:
        """is_notifying: READY=1 comes when all stages have started, WATCHDOG=1 while its main loop runs."""
        text = resources.files("fantwin").joinpath("deploy", "systemd", "fantwin.service.in").read_text("utf-8")
        notifying = "Type=notify\nNotifyAccess=main\nTimeoutStartSec=15min\nWatchdogSec=60"
        return Template(text).substitute(
            description=description,
            version=metadata.version("fantwin"),
            type=notifying if is_notifying else "Type=exec",
            command=_command_line(command),
            user=self.user,
            group=self.group,
            folder=str(self.config.parent).replace("%", "%%"),
            access="\n".join(self._access()),
        )

    def _access(self) -> Iterator[str]:
        """Where it writes, which devices it opens, what of the homes it sees."""
        if self.run_folder == STATE_FOLDER:
            yield f'# the configuration says run_folder = "{STATE_FOLDER}"'
            yield "StateDirectory=fantwin"
        else:
            yield f"ReadWritePaths={' '.join(_escaped(str(path)) for path in (self.run_folder, *self.written))}"
        shown = _in_homes([*self.installation, *self.read, self.config.parent])
        yield f"ProtectHome={'tmpfs' if shown else 'yes'}"
        if shown:
            yield "# of the homes, what it needs and no more"
            yield f"BindReadOnlyPaths={' '.join(shown)}"
        if changed := _in_homes([self.run_folder, *self.written]):
            yield f"BindPaths={' '.join(changed)}"
        if self.ports:
            yield "PrivateDevices=no\nDevicePolicy=closed"
            yield from (f"DeviceAllow=char-{kind} rw" for kind in self.ports)
        else:
            yield "PrivateDevices=yes"
        has_rules = self.chips or _IPMI in self.ports
        groups = [*self.groups, *([USER] if has_rules and self.group != USER else [])]
        if groups:
            yield f"SupplementaryGroups={' '.join(groups)}"
        if self.chips:
            yield "# pwmN of its chips is written, which is below /sys"
        yield f"ProtectKernelTunables={'no' if self.chips else 'yes'}"

    def _sysusers(self) -> Iterator[str]:
        """The user, or only the group that may command fans."""
        yield f'u {USER} - "fantwin" {STATE_FOLDER}\n' if self.user == USER else f"g {USER} -\n"


def _rule(chip: str) -> str:
    """Lets the group of the service write the commands of a chip, each time that the chip appears."""
    files = "/sys%p/pwm[0-9] /sys%p/pwm[0-9]_enable"
    script = f"chgrp -f {USER} {files}; chmod -f g+w {files}"
    return f'ACTION!="remove", SUBSYSTEM=="hwmon", ATTR{{name}}=="{chip}", RUN+="/bin/sh -c \'{script}\'"\n'


def owner_of(config: Path) -> str:
    """The person whose configuration it is; the service's own user where it is of root.

    Raises:
        UserError: nobody here has that number.
    """
    owner = config.stat().st_uid
    try:
        return pwd.getpwuid(owner).pw_name if owner else USER
    except KeyError as error:
        raise UserError(f"{config}: its owner {owner} is no user of this system: name one with --user") from error


def written_below(root: Path, files: Mapping[Path, str]) -> list[Path]:
    """Write files below a folder. Returns where they are.

    Raises:
        OSError: one cannot be written.
    """
    paths = [root / path for path in files]
    for path, text in zip(paths, files.values(), strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return paths


def _is_device(port: str) -> bool:
    return port.startswith("/dev/")


def _kinds(port: str) -> tuple[str, ...]:
    """The kind of a serial port as /proc/devices names it; of a link that leads nowhere now, those of USB."""
    found = re.match(r"/dev/(tty[A-Za-z]+)\d*$", str(Path(port).resolve()))
    return (found[1],) if found else _USB_PORTS


def _group_of(port: str) -> str:
    """Whose members may open a port; that of Debian where it is not there."""
    try:
        return grp.getgrgid(Path(port).stat().st_gid).gr_name
    except (OSError, KeyError):
        return "dialout"


def _command_line(words: Sequence[str]) -> str:
    """A command of a unit. `:`: a $ begins no variable. systemd starts no program with a quote in its name."""
    through = ["/usr/bin/env"] if re.search(r"""["'\\]""", words[0]) else []
    return ":" + " ".join(map(_escaped, (*through, *words)))


def unreadable_files(config: Config, user: str) -> list[Path]:
    """The files that the configuration names, or that are in folders that it names, which a user may not read."""
    named = {path for path in _named(config) if not path.is_relative_to("/sys")}
    files = {each for path in named for each in ([path] if path.is_file() else path.rglob("*")) if each.is_file()}
    try:
        of_user = pwd.getpwnam(user)
    except KeyError:  # it is made later
        uid, groups = -1, list[int]()
    else:
        uid, groups = of_user.pw_uid, os.getgrouplist(user, of_user.pw_gid)
    return sorted(each for each in {config.path.resolve(), *files} if not _is_readable(each.stat(), uid, groups))


def _is_readable(status: os.stat_result, uid: int, groups: Sequence[int]) -> bool:
    needed = stat.S_IRUSR if status.st_uid == uid else stat.S_IRGRP if status.st_gid in groups else stat.S_IROTH
    return uid == 0 or bool(status.st_mode & needed)


def _named(config: Config) -> set[Path]:
    """What the settings name by a path, and is there."""
    named = {(config.folder / path).resolve() for path in _paths((config.bus, config.trays, config.sections))}
    return {path for path in named if path.exists()}


def _folders_read(config: Config) -> set[Path]:
    """The folders of what the settings name by a path and is there: files such as those of users are replaced, by which
    a file that was bound alone would stay the old one."""
    return {path if path.is_dir() else path.parent for path in _named(config)}


def _paths(settings: object) -> Iterator[Path]:
    """All paths among settings."""
    if isinstance(settings, Path):
        yield settings
    elif isinstance(settings, BaseModel):
        yield from _paths([getattr(settings, name) for name in type(settings).model_fields])
    elif isinstance(settings, Mapping):
        yield from _paths(list(settings.values()))
    elif isinstance(settings, Sequence) and not isinstance(settings, str):
        for each in settings:
            yield from _paths(each)


def _in_homes(paths: Sequence[Path]) -> list[str]:
    """Those below a home, as a unit binds them: a colon would begin the place where they are shown."""
    return sorted({_escaped(str(path)).replace(":", "\\:") for path in paths if f"{path}/".startswith(_HOMES)})


def _escaped(word: str) -> str:
    """A word of a unit: %, quotes, backslashes and spaces mean something there."""
    quoted = re.sub(r"""(["'\\])""", r"\\\1", word.replace("%", "%%"))
    return f'"{quoted}"' if re.search(r"[^\w@%+=:,./-]", quoted) else quoted


def may_be_read(service: Service) -> str:
    """Which folder of the service its user cannot pass; empty if there is none. Homes are shown to it in part."""
    for path in (service.config, *service.installation):
        if f"{path}/".startswith(_HOMES):
            continue
        closed = [each for each in path.parents if each.is_dir() and not each.stat().st_mode & 0o001]
        if closed and service.user == USER:
            return str(closed[-1])
    return ""
