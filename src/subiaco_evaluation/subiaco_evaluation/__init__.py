"""Scores against truth, simple methods to compare with, and known changes put into real maps."""
