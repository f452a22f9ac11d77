"""Mail, chat and webhooks by apprise. What it says of a failure is cut to what holds no secret of the URL."""

from __future__ import annotations

import logging
import re
from typing import TYPE_CHECKING

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.notify.sending import Failure
from fantwin.pipeline.outputs.notify.wording import Level, Text

if TYPE_CHECKING:
    from apprise import AppriseAsset, NotifyBase

MAIL_PAUSE_S = 1.0
"""apprise would wait 5.5 s between mails"""
_KNOWN_REASONS = re.compile(
    r"\[Errno -?\d+\] [A-Za-z ]+|timed out|\[SSL: [A-Z_]+\]|Connection (?:unexpectedly closed|reset by peer)"
    r"|Remote end closed connection without response|\(\d{3}, b'[^']*'|error=\d{3}"
    r"|STARTTLS extension not supported by server|SMTP AUTH extension not supported by server"
)
"""in what apprise logs at level DEBUG, which may hold parts of the URL"""
_WHAT_TO_DO = {
    "STARTTLS extension": "the mail server has no TLS: mailto:// sends without, for all on the way to read",
    "SMTP AUTH extension": "the mail server takes no password without TLS, or none at all: leave user and password out "
    "of the URL, or use mailtos://",
    "[SSL: WRONG_VERSION_NUMBER]": "what listens there has no TLS at this port: check scheme and port",
    "[SSL: CERTIFICATE_VERIFY_FAILED]": "this host does not know the authority of the server's certificate",
}
_MAIL_NEEDS = "; a mail needs ?to=ADDRESS, and a user or from=ADDRESS"
_OF_FAILURES = ("WARNING", "ERROR", "CRITICAL")
_REFUSAL = re.compile(r"(?<!\d)5\d\d, b'|error=4(?!01|03|04|08|29)\d\d")
"""the answer of a server that does not want this message; not those that it gives to any"""
_UNCERTAIN = re.compile(r"timed out|closed|reset")


class Service:
    """One apprise URL. `deliver` is a `pipeline.outputs.notify.sending.Deliver`."""

    def __init__(self, url: str) -> None:
        """Check the URL.

        Raises:
            UserError: apprise does not know it, or it has several recipients.
        """
        from apprise import Apprise  # noqa: PLC0415  the extra may not be installed

        logger = logging.getLogger("apprise")
        logger.setLevel(logging.DEBUG)  # the reasons of failures: they get into its results only at this level
        logger.propagate = False  # and nowhere else: they may hold parts of the URL
        scheme = url.partition("://")[0] if "://" in url else "?"
        asset = _asset()
        service = Apprise.instantiate(url, asset=asset)
        if service is None:
            raise UserError(
                f"apprise cannot use this URL ({scheme}://...): it is unknown, or a part is missing; "
                f"https://appriseit.com/services lists them{_MAIL_NEEDS if scheme in ('mailto', 'mailtos') else ''}"
            )
        if (recipients := _recipients(service)) > 1:
            raise UserError(
                f"the URL ({scheme}://...) has {recipients} recipients: what one of them refuses would be sent to all "
                "again; make a target of each, or use a list's address"
            )
        self._apprise = Apprise(asset=asset)
        self._apprise.add(service)
        is_mail = service.__class__.__name__ == "NotifyEmail"
        self.pause_s = MAIL_PAUSE_S if is_mail else max(0.0, float(service.request_rate_per_sec))
        """least time between two messages"""
        service.request_rate_per_sec = 0  # the sender waits, and can be stopped while it does

    def deliver(self, text: Text) -> Failure | None:
        """Send a text; None: the service has taken it."""
        from apprise import NotifyFormat, NotifyType  # noqa: PLC0415  the extra may not be installed

        types = {
            Level.INFO: NotifyType.INFO,
            Level.GOOD: NotifyType.SUCCESS,
            Level.WARNING: NotifyType.WARNING,
            Level.ALARM: NotifyType.FAILURE,
        }
        try:
            result = self._apprise.notify(
                title=text.title,
                body=text.body,
                notify_type=types[text.level],
                body_format=NotifyFormat.TEXT,
                log_level=logging.DEBUG,
            )
        except Exception as error:  # noqa: BLE001  a service of apprise may raise anything
            return Failure(type(error).__name__, is_uncertain=True)
        if result:
            return None
        said = [(entry.level, entry.message) for each in result.results for entry in each.logs()]
        return _failure(said)


def _failure(said: list[tuple[str, str]]) -> Failure:
    """The reason of a failure from what apprise has logged: level and words of each line."""
    known = [match for _, words in said for match in _KNOWN_REASONS.findall(words)]
    warnings = [words.strip() for level, words in said if level in _OF_FAILURES]
    reason = "; ".join(dict.fromkeys(each.lstrip("(") for each in known)) or (warnings[-1] if warnings else "refused")
    reason = "; ".join((reason[:200], *(advice for sign, advice in _WHAT_TO_DO.items() if sign in reason)))
    return Failure(reason, is_uncertain=bool(_UNCERTAIN.search(reason)), is_refusal=bool(_REFUSAL.search(reason)))


def _asset() -> AppriseAsset:
    from apprise import AppriseAsset  # noqa: PLC0415  the extra may not be installed

    return AppriseAsset(
        app_id="fantwin",
        app_desc="fantwin",
        app_url="",
        async_mode=False,
        service_timeout=0,  # in the thread of the sender, which ends with the process
        pgp_autogen=False,
        pem_autogen=False,
    )


def _recipients(service: NotifyBase) -> int:
    copies = sum(len(getattr(service, name, None) or ()) for name in ("cc", "bcc"))
    return len(service) + copies
