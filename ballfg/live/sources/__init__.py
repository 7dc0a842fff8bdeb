"""Sources give positions from pipes, sockets, datasets and ROS 2 bags; live lines wait in a queue."""
