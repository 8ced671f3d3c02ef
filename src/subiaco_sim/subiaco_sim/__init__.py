"""Simulated surveys with truth: scene, changes, sensors, packets, bag."""
