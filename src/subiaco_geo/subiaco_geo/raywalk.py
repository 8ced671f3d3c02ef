"""The module of voxel traversal under the name by which the simulator, frozen by its hash, imports it."""

from subiaco_geo.voxel_traversal import VisibilityAccumulator

__all__ = ["VisibilityAccumulator"]
