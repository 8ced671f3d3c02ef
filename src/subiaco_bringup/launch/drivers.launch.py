"""Start the drivers of a vehicle, and publish where the sensors sit.

ros2 launch subiaco_bringup drivers.launch.py lidar:=ouster lidar_params:=os1.yaml config:=places.yaml
"""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription
from subiaco_bringup.defaults import config_files
from subiaco_bringup.drivers import (
    driver_actions,
    gnss_driver,
    in_namespace,
    lidar_driver,
    sensor_places,
)
from subiaco_bringup.launching import local_environment, split_paths, split_words
from subiaco_geo.config import load_config
from subiaco_mapping.config import MappingConfig

ARGUMENTS = (
    ("lidar", "none", "driver of the LiDAR: ouster (ouster_ros) or none"),
    ("lidar_params", "", "parameter file of that driver"),
    ("gnss", "none", "driver of the receiver: ublox (ublox_gps), septentrio or none"),
    ("gnss_params", "", "parameter file of that driver"),
    ("namespace", "", "namespace of the LiDAR and of the frames, one for each LiDAR where there are several"),
    ("config", "", "configuration files with the places of the sensors, separated by blanks"),
    ("set", "", "key=value settings, separated by blanks"),
)


def expand(context: object) -> list:
    """Return what starts, once the arguments are known; a setting that is none is refused before."""
    values = {name: LaunchConfiguration(name).perform(context) for name, _, _ in ARGUMENTS}
    files = config_files("mapping", tuple(split_paths(values["config"])))
    config = load_config(MappingConfig, files, split_words(values["set"]))
    lidar = lidar_driver(values["lidar"], values["lidar_params"]) + sensor_places(config.sensors)
    gnss = gnss_driver(values["gnss"], values["gnss_params"])
    return in_namespace(values["namespace"], driver_actions(lidar)) + driver_actions(gnss)


def generate_launch_description() -> LaunchDescription:
    """Return what ``ros2 launch`` runs."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, default, text in ARGUMENTS
    ]
    return LaunchDescription([*declared, *local_environment(), OpaqueFunction(function=expand)])
