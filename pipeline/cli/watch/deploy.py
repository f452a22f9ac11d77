"""`fantwin deploy`: the files for systemd, containers, Kubernetes and Grafana, which are part of the installation."""

from __future__ import annotations

import shutil
from enum import StrEnum
from importlib import metadata, resources
from pathlib import Path
from typing import Annotated

import typer

from fantwin.pipeline.cli.options import DEFAULT_CONFIG, JsonOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.cli.watch.service_files import Service, written_below
from fantwin.pipeline.errors import UserError


class Target(StrEnum):
    """What the files are for, as it is typed."""

    SYSTEMD = "systemd"
    COMPOSE = "compose"
    HELM = "helm"
    GRAFANA = "grafana"


_FOLDERS = {
    Target.COMPOSE: ("compose",),
    Target.HELM: ("kubernetes/fantwin",),
    Target.GRAFANA: ("grafana", "prometheus"),
}
"""below deploy/"""
_NEXT = {
    Target.SYSTEMD: "look at them, then: cp -r {out}/etc / && systemd-sysusers && systemctl enable --now fantwin",
    Target.COMPOSE: "put fantwin-{version}-py3-none-any.whl into {out}, then: cd {out} && docker compose up --build -d",
    Target.HELM: "helm install plant {out} --set-file config=fantwin.toml -f VALUES.yaml; see {out}/README.md",
    Target.GRAFANA: "import {out}/fantwin.json into Grafana; give {out}/prometheus.yml and its rules to Prometheus",
}
_SITE = {
    Target.COMPOSE: "the site is a simulated tray, by {out}/site/fantwin.toml{unused}: put your [[tray]] there, and "
    "see `acquisition` in {out}/compose.yaml",
}
"""which site the files run, where no option of the next command says it"""


def deploy(
    target: Annotated[Target, typer.Argument(metavar="TARGET", help=f"{', '.join(Target)}.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FOLDER", help="A new folder for the files.")],
    json_output: JsonOption = False,
) -> None:
    """Write the files that deploy fantwin (docs/how-to/deployment.md).

    systemd: units of site and router, for /opt/fantwin and /etc/fantwin/fantwin.toml. compose: image and site, with the
    operators' page, Prometheus and Grafana. helm: the chart. grafana: dashboard, scrape configuration, alert rules.

    Example: fantwin deploy compose -o site

    Example: fantwin deploy helm -o chart
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out}: exists; name a new folder with -o")
    try:
        if target is Target.SYSTEMD:
            written_below(
                out, Service(ports=("ttyUSB", "ttyACM", "ttyS"), groups=("dialout",)).files() | Service().router()
            )
        for name in _FOLDERS.get(target, ()):
            with resources.as_file(resources.files("fantwin").joinpath("deploy", *name.split("/"))) as folder:
                shutil.copytree(folder, out, dirs_exist_ok=True)
    except OSError as error:
        raise UserError(f"{out}: cannot be written: {error.strerror or error}") from error
    files = sorted(str(path) for path in out.rglob("*") if path.is_file())
    following = _NEXT[target].format(out=out, version=metadata.version("fantwin"))
    unused = f" and not by {DEFAULT_CONFIG}" if DEFAULT_CONFIG.exists() else ""
    site = _SITE.get(target, "").format(out=out, unused=unused)
    lines = [*files, *([site] if site else []), f"next: {following}"]
    show({"files": files, "site": site, "next": following}, *lines, json_output=json_output)
