"""The metadata and attachments of a recorder's recording: site and trays, the configuration, and the twins."""

from __future__ import annotations

import hashlib
import json
import logging

from fantwin.pipeline.recordings.reading import NAMES_KEY, TACHO_KEY
from fantwin.pipeline.runtime.stage import Context
from fantwin.schemas.tacho import INSTANTANEOUS, tachos_to_json

CONFIGURATION = "configuration.toml"
_LOG = logging.getLogger(__name__)


def recording_metadata(context: Context) -> tuple[dict[str, str], dict[str, bytes]]:
    """Metadata and attachments of every part: all that is needed to read it and to score it again, anywhere."""
    metadata = {
        "site": context.site,
        "trays": ",".join(tray.name for tray in context.trays),
    }
    if context.overrides:
        metadata["overrides"] = json.dumps(context.overrides)
    attachments = {CONFIGURATION: context.configuration_text.encode()}
    for tray in context.trays:
        metadata[f"fans.{tray.name}"] = str(tray.fans)
        metadata[f"speed_unit.{tray.name}"] = tray.speed_unit
        if any(tray.names.names):
            metadata[f"{NAMES_KEY}.{tray.name}"] = tray.names.as_json()
        if tray.tachos != INSTANTANEOUS:
            metadata[f"{TACHO_KEY}.{tray.name}"] = tachos_to_json(tray.tachos)
        if tray.twin is not None:
            path = context.resolve(tray.twin)
            try:
                twin = path.read_bytes()
            except OSError as error:
                _LOG.warning("%s: the twin is not in the recording: %s", path, error.strerror)
                continue
            metadata[f"twin_sha256.{tray.name}"] = hashlib.sha256(twin).hexdigest()
            attachments[f"{tray.name}.onnx"] = twin
    return metadata, attachments
