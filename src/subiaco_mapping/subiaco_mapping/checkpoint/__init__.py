"""Finished recordings of a mapping run, kept until the map is written."""
