"""`fantwin doctor`: what is wrong with an installation or a configuration, and what to do about it."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from pipeline.cli.options import JsonOption, SetOption
from pipeline.config.models import Config, ConfigError, load_config
from pipeline.config.registry import load_stage
from pipeline.launch.processes import process_list
from pipeline.optional_dependencies import how_to_install
from pipeline.runtime.stage import Context

_NEEDED = ("eclipse-zenoh", "numpy", "onnxruntime", "mcap", "protobuf", "pydantic", "pyserial", "cobs")
_EXTRAS = {"view": ("rerun-sdk", "matplotlib"), "train": ("torch", "onnx", "scipy")}
_LITTLE_DISK_BYTES = 1 << 30


def doctor(
    config: Annotated[Path | None, typer.Option("-c", "--config", help="Also check this configuration.")] = None,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """Tell what is wrong with the installation, and with a configuration if one is given.

    Exit code 1 when something must be mended.

    Example: fantwin doctor -c fantwin.toml
    """
    problems, good = [], []
    for ok, line in _findings(config, overrides):
        (good if ok else problems).append(line)
    if json_output:
        typer.echo(json.dumps({"ok": not problems, "problems": problems, "good": good}))
    else:
        console = Console(soft_wrap=True, highlight=False)
        for mark, style, lines in (("ok  ", "green", good), ("MEND", "bold red", problems)):
            for line in lines:
                console.print(f"[{style}]{mark}[/{style}] ", end="")
                console.print(line, markup=False)
    if problems:
        raise typer.Exit(1)


def _findings(config: Path | None, overrides: list[str] | None) -> Iterator[tuple[bool, str]]:
    """(fine or not, one line) for everything looked at."""
    yield True, f"Python {sys.version.split()[0]}"
    for name in _NEEDED:
        found = _version(name)
        yield bool(found), f"{name} {found}" if found else f"{name} is not installed; {how_to_install()}"
    for extra, names in _EXTRAS.items():
        missing = [name for name in names if not _version(name)]
        line = f"extra {extra!r}: " + (
            f"not installed ({', '.join(missing)}); {how_to_install(extra)}" if missing else "installed"
        )
        yield True, line
    if config is None:
        return
    try:
        settings = load_config(config, overrides or ())
    except ConfigError as error:
        yield False, str(error)
        return
    yield True, f"{config}: site {settings.site!r}, trays {', '.join(tray.name for tray in settings.trays)}"
    yield from _check_run_folder(settings.run_folder)
    yield from _check_stages(settings)


def _check_run_folder(folder: Path) -> Iterator[tuple[bool, str]]:
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        yield False, f"run_folder {folder}: {existing} is no folder this user may write in; name another"
        return
    free = shutil.disk_usage(existing).free
    enough = free > _LITTLE_DISK_BYTES
    yield (
        enough,
        f"run_folder {folder}: {free / 1e9:.1f} GB free" + ("" if enough else "; make room or name another folder"),
    )


def _check_stages(config: Config) -> Iterator[tuple[bool, str]]:
    for row in process_list(config):
        stage = load_stage(row.stage)
        trays = (config.tray(row.tray),) if row.tray else config.trays
        groups = [(tray,) for tray in trays] if stage.core_per_tray else [trays]
        problems = [
            problem
            for group in groups
            for problem in stage.check(
                Context(
                    site=config.site,
                    trays=group,
                    config=config.sections[row.stage],
                    folder=config.folder,
                    run_folder=config.run_folder,
                    started_t_ns=time.time_ns(),
                )
            )
        ]
        yield from ((False, f"{row.label}: {problem}") for problem in problems)
        if not problems:
            yield True, f"{row.label}: can start"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
