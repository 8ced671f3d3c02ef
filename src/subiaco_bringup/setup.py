"""Package description for colcon and pip alike."""

from glob import glob
from pathlib import Path
from xml.etree import ElementTree as ET

from setuptools import find_packages, setup

NAME = "subiaco_bringup"
MANIFEST = ET.parse(Path(__file__).resolve().with_name("package.xml"))

setup(
    name=NAME,
    version=MANIFEST.findtext("version"),
    description="The one place that composes: the subiaco command, node graph, launch files, configuration.",
    maintainer="Subiaco maintainers",
    maintainer_email="maintainers@subiaco.example.org",
    license="Apache-2.0",
    packages=find_packages(include=[NAME, NAME + ".*"]),
    package_data={NAME: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + NAME]),
        ("share/" + NAME, ["package.xml"]),
        ("share/" + NAME + "/config", glob("config/*.yaml")),
        ("share/" + NAME + "/config/drivers", glob("config/drivers/*.yaml")),
        ("share/" + NAME + "/config/dds", glob("config/dds/*")),
        ("share/" + NAME + "/launch", glob("launch/*.launch.py")),
        ("share/" + NAME + "/systemd", glob("systemd/*.service")),
        ("share/" + NAME + "/rviz", glob("rviz/*.rviz")),
        ("share/" + NAME + "/foxglove", glob("foxglove/*.json")),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "subiaco = subiaco_bringup.cli.main:main",
            "change_node = subiaco_bringup.nodes.executables:change_node",
            "composed_nodes = subiaco_bringup.nodes.executables:composed_nodes",
            "foxglove_node = subiaco_bringup.nodes.executables:foxglove_node",
        ],
    },
)
