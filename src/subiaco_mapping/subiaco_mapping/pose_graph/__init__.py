"""Odometry, fixes and loops to one solution for all recordings."""
