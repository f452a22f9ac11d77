"""Digital twins of fans, from Python: push samples, and read recordings into arrays.

    import fantwin

    scores = fantwin.read_arrays(Path("runs/demo/recording.mcap"), "score")
    with fantwin.connect("tcp/127.0.0.1:7447", site="plant") as client:
        ...

`fantwin.client` has the errors of a connection, `fantwin.pipeline.recordings` what else reads recordings. The folders
of the repository are its packages, by links: `scoring/` is `fantwin.scoring`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fantwin.client import connect
    from fantwin.pipeline.recordings import read_arrays, read_metadata, read_recording

__all__ = ["connect", "read_arrays", "read_metadata", "read_recording"]


def __getattr__(name: str) -> Any:
    """Import what is asked for only then, since every stage imports this package.

    Raises:
        AttributeError: there is no such name.
    """
    if name not in __all__:
        raise AttributeError(f"module 'fantwin' has no attribute {name!r}")
    return getattr(import_module("fantwin.client" if name == "connect" else "fantwin.pipeline.recordings"), name)
