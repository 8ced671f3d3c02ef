"""Scores against truth, by the published protocol and by object."""
