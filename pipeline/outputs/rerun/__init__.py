"""Displays: the Rerun view, pictures and plots."""

import os

# Rerun reads it when it is imported: otherwise every start warns of the missing footer
os.environ.setdefault("RUST_LOG", "warn,re_log_encoding=error")
