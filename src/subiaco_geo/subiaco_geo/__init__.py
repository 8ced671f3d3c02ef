"""Base package: point clouds, frames, coordinate systems, files, configuration, errors.

No ROS and no SLAM library is imported here; every other room builds on this one.
"""

__version__ = "0.2.0"
