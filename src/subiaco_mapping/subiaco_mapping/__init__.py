"""Packets to scans to poses to one georeferenced map of an epoch."""
