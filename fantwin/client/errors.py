"""What can go wrong, one class each. Every message is one line that says what, where and what to do."""

from __future__ import annotations

from fantwin.pipeline.errors import FantwinError


class ClientError(FantwinError):
    """Base of all errors of this package; the bus itself raises `fantwin.client.BusError`."""


class NoAcquisitionError(ClientError):
    """No acquisition of the tray is at work, or the source of its tray is another one."""


class NotAllowedError(ClientError):
    """The certificate may not publish samples of the tray, or the router refuses it."""


class FanCountError(ClientError):
    """Values of another number of fans than the tray has. None of the samples was taken."""


class CommandError(ClientError):
    """A command that is NaN, or outside the limits of the tray. None of the samples was taken."""


class TimeOrderError(ClientError):
    """A time that is not after the one before. None of the samples was taken."""


class NotKeptError(ClientError):
    """Acquisition is gone or behind, and the client keeps as many samples as it may. None of these was taken; they are
    counted in `Losses.not_kept`."""


class NotReceivedError(ClientError):
    """Acquisition has not confirmed all samples in time. As long as the client is open they are kept."""


class SamplesLostError(ClientError):
    """Samples that were published did not become samples of the site."""


class SendError(ClientError):
    """The thread that sends has failed, the cause is attached: nothing more is sent. Open the client again."""
