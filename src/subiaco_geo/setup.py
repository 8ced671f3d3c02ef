"""Package description for colcon and pip alike."""

from pathlib import Path
from xml.etree import ElementTree as ET

from setuptools import find_packages, setup

NAME = "subiaco_geo"
MANIFEST = ET.parse(Path(__file__).resolve().with_name("package.xml"))

setup(
    name=NAME,
    version=MANIFEST.findtext("version"),
    description="Point clouds, frames, coordinate systems, files, configuration, errors: no ROS, no SLAM.",
    maintainer="Subiaco maintainers",
    maintainer_email="maintainers@subiaco.example.org",
    license="Apache-2.0",
    packages=find_packages(include=[NAME, NAME + ".*"]),
    package_data={NAME: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + NAME]),
        ("share/" + NAME, ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"], "object-storage": ["fsspec"], "s3": ["s3fs"]},
    zip_safe=False,
)
