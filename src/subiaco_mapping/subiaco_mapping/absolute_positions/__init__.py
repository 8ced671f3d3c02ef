"""Absolute positions beside GNSS: surveyed control points, and a reference cloud."""
