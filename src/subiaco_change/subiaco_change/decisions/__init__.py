"""Measures of matched objects, and the label that follows from them (method, part E)."""
