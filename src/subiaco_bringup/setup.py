"""Package description for colcon and pip alike."""

from glob import glob

from setuptools import find_packages, setup

NAME = "subiaco_bringup"

setup(
    name=NAME,
    version="0.1.0",
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
        ],
    },
)
