"""Fans whose values a Prometheus has, or an exporter shows."""
