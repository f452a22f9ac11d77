"""`fantwin users`: what the file of users holds then."""

from __future__ import annotations

import json
import os
import pwd
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from argon2 import PasswordHasher

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.site.users import Users
from tests.support.fantwin_command import fantwin
from tests.support.site_users import make_users

PASSWORD, OTHER_PASSWORD = "correct horse battery", "another horse battery"


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    quick = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)
    for place in ("fantwin.pipeline.site.users", "fantwin.pipeline.cli.watch.users"):
        monkeypatch.setattr(f"{place}.hasher", lambda: quick)
    path = tmp_path / "fantwin.toml"
    path.write_text('[[tray]]\nname = "tray1"\nfans = 1\n[gateway]\nusers = "users.toml"\n')
    return path


def add(config: Path, name: str, password: str, *words: str) -> None:
    done = fantwin("users", "add", name, "-c", config, *words, typed=f"{password}\n")
    assert done.exit_code == 0, done.output
    assert password not in done.output


def test_users_are_added_changed_listed_and_removed_and_only_the_owner_reads_the_file(config):
    add(config, "ann", PASSWORD, "--role", "operator")
    add(config, "vic", PASSWORD)
    add(config, "ann", OTHER_PASSWORD)
    path = config.parent / "users.toml"
    assert path.stat().st_mode & 0o777 == 0o600
    assert PASSWORD not in path.read_text()
    listed = json.loads(fantwin("users", "-c", config, "--json").stdout)
    assert listed == [{"kind": "user", "name": name, "role": "viewer"} for name in ("ann", "vic")]
    users = Users(path)
    assert users.verified("ann", PASSWORD) is None
    assert users.verified("ann", OTHER_PASSWORD) is not None
    assert fantwin("users", "remove", "ann", "-c", config).exit_code == 0
    assert users.verified("ann", OTHER_PASSWORD) is None, "from the next request on"
    path.chmod(0o644)
    with pytest.raises(UserError, match="others may read it"):
        Users(path)


@pytest.mark.skipif(os.getuid() != 0, reason="only root becomes another user")
def test_a_file_that_another_user_made_is_named_with_its_owner_and_what_to_do(config):
    with TemporaryDirectory() as folder:
        path = make_users(Path(folder) / "users.toml")
        said: list[str] = []
        for mode in (0o755, 0o700):
            path.parent.chmod(mode)
            os.seteuid(pwd.getpwnam("nobody").pw_uid)
            try:
                with pytest.raises(UserError) as refused:
                    Users(path)
            finally:
                os.seteuid(0)
            said.append(str(refused.value))
    assert said == [
        f"{path}: it belongs to root, and nobody may not read it: chown nobody {path}",
        f"{path}: nobody may not look into its folder: chmod o+x {folder}",
    ]


def test_a_password_that_is_too_short_is_refused_and_changes_nothing(config):
    assert "12 to 128" in str(fantwin("users", "add", "ann", "-c", config, typed="short\n").exception)
    assert not (config.parent / "users.toml").exists()


def test_a_token_is_shown_once_listed_with_its_end_and_removed(config):
    done = fantwin("users", "add-token", "grafana", "-c", config, "--role", "operator", "--days", "30", "--json")
    text = json.loads(done.stdout)["token"]
    path = config.parent / "users.toml"
    assert path.stat().st_mode & 0o777 == 0o600
    assert text not in path.read_text()
    tokens = Users(path)
    assert tokens.of("grafana") is None, "nobody logs in with a token"
    (found,) = filter(None, [tokens.of_token(text)])
    assert (found.name, found.role) == ("grafana", "operator")
    assert Users(path, lambda: time.time() + 31 * 86_400).of_token(text) is None
    (listed,) = json.loads(fantwin("users", "-c", config, "--json").stdout)
    assert (listed["kind"], listed["name"], listed["expires"][:2]) == ("token", "grafana", "20")
    assert "grafana  operator  token, until 20" in fantwin("users", "-c", config).stdout
    assert "is a token" in str(fantwin("users", "add", "grafana", "-c", config, typed=f"{PASSWORD}\n").exception)
    again = f"{path}: grafana has a token: end that first: fantwin users remove-token grafana"
    assert str(fantwin("users", "add-token", "grafana", "-c", config).exception) == again
    assert tokens.of_token(text) is not None, "the program that has it goes on"
    assert fantwin("users", "remove-token", "grafana", "-c", config).exit_code == 0
    assert tokens.of_token(text) is None, "from the next request on"
    assert fantwin("users", "add-token", "grafana", "-c", config, "--days", "inf").exit_code == 2
    path.write_text('[grafana]\nrole = "root"\n')
    path.chmod(0o600)
    assert "[grafana] is no user and no token" in str(fantwin("users", "-c", config).exception)
