"""ROS 2 nodes: parameters -> frozen configuration -> library step -> publish."""
