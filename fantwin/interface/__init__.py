"""Twins from Python: tables in, tables out, without a bus and without files."""
