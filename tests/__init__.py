"""Tests, in the folders of the code that they test; `system/` for whole chains, `support/` for helpers."""
