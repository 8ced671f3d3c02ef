"""Packets and messages to scans with a time for every point, deskewed."""
