"""Package description for colcon and pip alike."""

from pathlib import Path
from xml.etree import ElementTree as ET

from setuptools import find_packages, setup

NAME = "subiaco_mapping"
MANIFEST = ET.parse(Path(__file__).resolve().with_name("package.xml"))

setup(
    name=NAME,
    version=MANIFEST.findtext("version"),
    description="Packets to scans to poses to one georeferenced map of an epoch, with its ROS 2 nodes.",
    maintainer="Subiaco maintainers",
    maintainer_email="maintainers@subiaco.example.org",
    license="Apache-2.0",
    packages=find_packages(include=[NAME, NAME + ".*"]),
    package_data={NAME: ["py.typed", "**/*.j2"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + NAME]),
        ("share/" + NAME, ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "replay_node = subiaco_mapping.nodes.executables:replay_node",
            "recorder_node = subiaco_mapping.nodes.executables:recorder_node",
            "monitor_node = subiaco_mapping.nodes.executables:monitor_node",
            "odometry_node = subiaco_mapping.nodes.executables:odometry_node",
            "pose_graph_node = subiaco_mapping.nodes.executables:pose_graph_node",
        ],
    },
)
