"""Users of a page or an OPC UA server in tests, whose passwords are hashed in no time."""

from __future__ import annotations

from pathlib import Path

from argon2 import PasswordHasher

from fantwin.pipeline.site.users import Accounts, User, UserRole, write_accounts

PASSWORD = "correct horse battery"
OPERATOR, VIEWER = "ann", "vic"
ROLES = {OPERATOR: UserRole.OPERATOR, VIEWER: UserRole.VIEWER}


def quick_hasher() -> PasswordHasher:
    return PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)


def make_users(path: Path, password: str = PASSWORD, **roles: UserRole) -> Path:
    """A file with these users, or with the operator ann and the viewer vic."""
    hashed = quick_hasher().hash(password)
    write_accounts(path, Accounts({name: User(name, role, hashed) for name, role in (roles or ROLES).items()}))
    return path
