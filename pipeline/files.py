"""Files that are written whole: a reader finds the file of before or the new one, also after a power cut."""

from __future__ import annotations

import os
import pwd
import secrets
import shlex
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from fantwin.pipeline.errors import UserError

PRIVATE, PUBLIC = 0o600, 0o644
_AS_THE_USER_WISHES = 0o666
"""less what the umask takes"""


_OTHERS, _GROUP_OR_OTHERS = 0o007, 0o077


def is_read_by_others(status: os.stat_result) -> bool:
    """Whether a secret file may be read by others than its owner. As for ssh and PostgreSQL, its group may read it if
    it belongs to root, as where a service manager or a cluster hands it to a process of another user."""
    forbidden = _OTHERS if status.st_uid == 0 != os.geteuid() else _GROUP_OR_OTHERS
    return bool(stat.S_IMODE(status.st_mode) & forbidden)


def closed_to(path: Path, uid: int) -> str:
    """Whose a file is that a process of another user cannot read, and what to do."""
    name = user_name(uid)
    try:
        owner = user_name(path.stat().st_uid)
    except OSError:
        return f"{name} may not look into its folder: chmod o+x {shlex.quote(str(path.parent))}"
    return f"it belongs to {owner}, and {name} may not read it: chown {name} {shlex.quote(str(path))}"


def user_name(uid: int) -> str:
    """Name of a user of this system; the number of one without a name."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def replace_file(path: Path, content: bytes, mode: int | None = None) -> None:
    """Put a file in its place, with its folders.

    Args:
        path: the file; one that is there is replaced.
        content: all of it.
        mode: who may read and write it, from its first moment on; None: as the one that it replaces, or as the process
            makes files. The owner stays that of the one that it replaces, where the process may say so.

    Raises:
        OSError: it cannot be written; the file of before is still there.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    before = path.stat() if path.exists() else None
    unfinished = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        descriptor = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode or _AS_THE_USER_WISHES)
        with os.fdopen(descriptor, "wb") as file:
            if before is not None:
                with suppress(PermissionError):
                    os.fchown(descriptor, before.st_uid, before.st_gid)
            wanted = mode if mode is not None else before and before.st_mode
            if wanted is not None:
                os.fchmod(descriptor, wanted)
            file.write(content)
            file.flush()
            os.fsync(descriptor)
        unfinished.replace(path)
    except OSError:
        with suppress(OSError):
            unfinished.unlink()
        raise
    with suppress(OSError):  # the new file is there; some file systems cannot do it
        sync_folder(path.parent)


def write_whole(
    path: Path, content: bytes, advice: str = "; name another file with -o", mode: int | None = None
) -> None:
    """Write a file as a whole: no reader finds a part of it. mode: as of `replace_file`.

    Raises:
        UserError: it cannot be written.
    """
    try:
        replace_file(path, content, mode)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}{advice}") from error


def make_folder(folder: Path) -> Path:
    """Create the folder if it is missing.

    Raises:
        UserError: it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be created: {error.strerror}; name another folder with -o") from error
    return folder


@contextmanager
def temporary_folder(beside: Path) -> Iterator[Path]:
    """A folder in another one, which is created if it is missing; deleted with its content at the end.

    Raises:
        UserError: it cannot be created.
    """
    try:
        temporary = TemporaryDirectory(dir=make_folder(beside), prefix=".fantwin-")
    except OSError as error:
        raise UserError(f"{beside}: cannot be written: {error.strerror}; name another folder with -o") from error
    with temporary as name:
        yield Path(name)


def sync_folder(folder: Path) -> None:
    """Flush a folder to the disk: its file names then survive a power cut. OSError if that fails."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
