"""Scans to poses: registration against a local map."""
