"""Nodes that join packages which do not know each other."""
