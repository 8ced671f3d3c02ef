"""Instances that one epoch separates and the other merges, split alike in both epochs."""
