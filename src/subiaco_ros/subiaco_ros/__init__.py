"""What every ROS 2 node of Subiaco shares: parameters, quality of service, messages, start and end."""
