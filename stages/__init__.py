"""Stages, one independent stage a module; none imports another."""
