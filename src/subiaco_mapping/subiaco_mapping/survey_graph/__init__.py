"""Pose graph of a survey: recordings placed and joined, loops closed, control points added, solved."""
