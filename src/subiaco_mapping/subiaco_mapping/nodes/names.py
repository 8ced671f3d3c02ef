"""Topics between our own nodes, as they resolve at the root."""

from __future__ import annotations

SEQUENCE = "/replay/sequence"
END = "/replay/end"

ODOMETRY = "/odometry"
CLOUD = "/points_deskewed"
SKY = "/points_sky"
QUALITY = "/odometry/quality"
FACTS = "/odometry/facts"
ODOMETRY_SEQUENCE = "/odometry/sequence"
ODOMETRY_END = "/odometry/end"
