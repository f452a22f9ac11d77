"""`fantwin doctor notify`: a test message to the targets of the notifier."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.outputs.notify.config import NotifierConfig
from fantwin.pipeline.outputs.notify.targets import send_test
from fantwin.pipeline.outputs.notify.wording import Place


def send_test_messages(config: Path, overrides: Sequence[str], targets: Sequence[str], *, json_output: bool) -> None:
    """Send a test message to the targets of the notifier, which need not be running. targets: names; empty for all.

    Raises:
        UserError: there is no such target, or one did not accept its message.
    """
    settings = load_config(config, overrides, stages=("notifier",))
    section = settings.sections["notifier"]
    assert isinstance(section, NotifierConfig)
    known = {target.name: target for target in section.target}
    if not known:
        raise UserError(f"{config}: no targets: add a table [[notifier.target]] with a name and url_file")
    if unknown := [name for name in targets if name not in known]:
        raise UsageError(f"{config}: no target {', '.join(unknown)}: there is {', '.join(known)}")

    place = Place(settings.site, section.page)
    failed: list[str] = []
    for name in targets or known:
        try:
            failure = send_test(known[name], settings.folder.joinpath, place)
            reason = failure.reason if failure else ""
        except UserError as error:
            reason = str(error)
        if reason:
            failed.append(name)
        line = f"{name}: {f'not delivered: {reason}' if reason else 'delivered'}"
        show({"target": name, "delivered": not reason, "reason": reason}, line, json_output=json_output)
    if failed:
        raise UserError(f"no test message for {', '.join(failed)}")
