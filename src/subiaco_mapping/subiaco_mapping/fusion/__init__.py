"""Scans at their solved poses to one map."""
