"""The times of the samples in a message."""

from __future__ import annotations

import numpy as np

from fantwin.schemas.messages import Array, Grid, Message, Prediction, Raw, Score


def sample_times(message: Message) -> Array:
    """(samples,) ns since the epoch; empty for a message without samples."""
    if isinstance(message, Raw):
        return message.host_receive_t_ns
    return message.t_ns if isinstance(message, Grid | Prediction | Score) else np.zeros(0, np.int64)
