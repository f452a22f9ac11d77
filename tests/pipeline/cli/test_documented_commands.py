"""The documents and the operators' page: each command line that they show has a command and options that there are."""

from __future__ import annotations

import re
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path

import pytest
from typer.main import get_command

from fantwin.pipeline.cli import main as command_line
from fantwin.pipeline.cli.main import COMMANDS
from fantwin.pipeline.cli.twins.twins import VersionAction
from fantwin.pipeline.cli.watch.certs import Action
from fantwin.pipeline.cli.watch.deploy import Target
from fantwin.pipeline.cli.watch.doctor import Task
from fantwin.pipeline.cli.watch.service import ServiceTask
from fantwin.pipeline.cli.watch.users import UserAction

ROOT = Path(__file__).parents[3]
FOLDERS = {"docs": "**/*.md", "examples": "**/*.md", ".": "*.md", "pipeline/outputs/web/page": "*.js"}
PAGES = sorted(path for folder, pages in FOLDERS.items() for path in (ROOT / folder).glob(pages))
OF_THE_PROGRAM = ("--help", "--version")
ACTIONS: dict[str, type[StrEnum]] = {
    "certs": Action,
    "deploy": Target,
    "doctor": Task,
    "service": ServiceTask,
    "twins": VersionAction,
    "users": UserAction,
}
"""what the first argument of a command is, if it is a word"""
FIRST_WORDS = {command: {action.value for action in actions} for command, actions in ACTIONS.items()}


@pytest.fixture(scope="module")
def options() -> dict[str, set[str]]:
    """Of each command."""
    registered = {command.name for command in command_line.app.registered_commands}
    command_line._register(name for name in COMMANDS if name not in registered)
    commands = get_command(command_line.app).commands  # type: ignore[attr-defined]
    return {
        name: {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        for name, command in commands.items()
    }


def command_lines(page: Path) -> Iterator[str]:
    """What a page shows after the name of the program: in its blocks of code, and within its sentences."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    code = [*re.findall(r"^ {4,}(.*)$", text, re.MULTILINE), *"\n".join(text.split("```")[1::2]).splitlines()]
    shown = [re.match(r"\s*(?:\$ )?(?:[A-Z_]+=\S+ )*(?:sudo )?fantwin (.*)$", line) for line in code]
    yield from (re.split(r" #|[|;&>]", line[1])[0] for line in shown if line)
    yield from (" ".join(found.split()) for found in re.findall(r"(?:`|command\(\")fantwin ([^`\"]*)", text))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_command_lines_of_a_page_can_be_given(page: Path, options: dict[str, set[str]]) -> None:
    wrong: list[str] = []
    for line in command_lines(page):
        words = re.sub(r"'[^']*'|\"[^\"]*\"", "''", line).split()
        if not words or not re.fullmatch("[a-z-]+", words[0]) or words[0] in OF_THE_PROGRAM:
            continue
        known = options.get(words[0])
        given = {word.partition("=")[0] for word in words[1:] if re.match("--?[a-z]", word)}
        names_another = words[0] in FIRST_WORDS and re.fullmatch("[a-z]+(-[a-z]+)*", "".join(words[1:2]))
        if known is None or given - known - {"--help"} or (names_another and words[1] not in FIRST_WORDS[words[0]]):
            wrong.append(line)
    assert not wrong
