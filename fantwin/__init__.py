"""Digital twins of fans, from Python.

    import fantwin

    twin = fantwin.load("fan.onnx")
    scored = twin.score(table)            # pandas, pyarrow or a dict of arrays
    twin = fantwin.train(healthy_table)

`docs/how-to/python.md` is the guide. `connect` pushes samples to a site (`fantwin.client`), `read_arrays` and its like
read recordings (`fantwin.pipeline.recordings`). The folders of the repository are its packages, by links: `scoring/` is
`fantwin.scoring`.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fantwin.client import connect
    from fantwin.interface.columns import Columns
    from fantwin.interface.making import calibrate, train
    from fantwin.interface.twin import Twin, load
    from fantwin.interface.words import FantwinWarning
    from fantwin.pipeline.errors import FantwinError
    from fantwin.pipeline.recordings import read_arrays, read_metadata, read_recording

__all__ = [
    "Columns",
    "FantwinError",
    "FantwinWarning",
    "Twin",
    "calibrate",
    "connect",
    "load",
    "read_arrays",
    "read_metadata",
    "read_recording",
    "train",
]
_MODULES = {
    "Columns": "interface.columns",
    "FantwinError": "pipeline.errors",
    "FantwinWarning": "interface.words",
    "Twin": "interface.twin",
    "calibrate": "interface.making",
    "connect": "client",
    "load": "interface.twin",
    "train": "interface.making",
}


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    """Import what is asked for only then, since every stage imports this package.

    Raises:
        AttributeError: there is no such name.
    """
    if name == "__version__":
        return version("fantwin")
    if name not in __all__:
        raise AttributeError(f"module 'fantwin' has no attribute {name!r}")
    return getattr(import_module(f"fantwin.{_MODULES.get(name, 'pipeline.recordings')}"), name)
