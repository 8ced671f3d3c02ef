"""Watching a survey while it is driven: what is wrong, since when, and where to drive again. No ROS here."""
