"""Draw the node graph of the README: ``python scripts/draw_graph.py`` writes docs/pictures/graph.png."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyBboxPatch

#: Node boxes: label, centre, what it does.
NODES = {
    "replay": ((1.2, 2.0), "replay\n(or live drivers)"),
    "odometry": ((5.0, 2.9), "odometry\ndecode · deskew · kiss-icp"),
    "pose_graph": ((9.2, 2.0), "pose_graph\ngtsam · GNSS · fused map"),
    "change": ((13.6, 2.0), "change\nregister · objects · decide"),
}

#: Arrows: from, to, bend, position of the label, topics.
TOPICS = (
    (
        "replay",
        "odometry",
        0.0,
        (2.1, 3.25),
        "/ouster/metadata\n/ouster/lidar_packets\n/imu/data  /tf_static",
    ),
    ("replay", "pose_graph", 0.2, (5.2, 0.78), "/gnss/fix   /tf_static"),
    ("odometry", "pose_graph", 0.0, (7.9, 3.1), "/odometry   /tf\n/points_deskewed"),
    ("pose_graph", "change", 0.0, (11.4, 2.42), "map directories\n/map/points\n/path"),
)
BOX, INK, LINE = "#eef3f8", "#16324f", "#5b7a99"


def draw(path: Path) -> None:
    """Write the picture to a PNG file."""
    figure, axes = plt.subplots(figsize=(14, 3.4), dpi=110)
    for source, target, bend, place, text in TOPICS:
        style = {"arrowstyle": "-|>", "color": LINE, "lw": 1.6, "shrinkA": 68, "shrinkB": 72}
        style["connectionstyle"] = f"arc3,rad={bend}"
        axes.annotate("", NODES[target][0], NODES[source][0], arrowprops=style)
        axes.text(*place, text, ha="center", va="center", fontsize=8, family="monospace", color=INK)
    for centre, text in NODES.values():
        corner = (centre[0] - 1.2, centre[1] - 0.34)
        axes.add_patch(
            FancyBboxPatch(corner, 2.4, 0.68, boxstyle="round,pad=0.06", fc=BOX, ec=INK, lw=1.4, zorder=3)
        )
        axes.text(*centre, text, ha="center", va="center", fontsize=9, color=INK, zorder=4)
    outputs = "/change/table  /change/before\n/change/after  /change/markers"
    axes.text(13.6, 1.2, outputs, ha="center", va="center", fontsize=8, family="monospace", color=INK)
    back = "consumers publish /replay/consumed: the replay waits for them, nothing is lost"
    axes.text(7.4, 0.3, back, ha="center", fontsize=8.5, style="italic", color=LINE)
    axes.set(xlim=(-0.1, 15.0), ylim=(0.1, 3.9))
    axes.axis("off")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, bbox_inches="tight", facecolor="white")


if __name__ == "__main__":
    draw(Path(__file__).resolve().parents[1] / "docs" / "pictures" / "graph.png")
