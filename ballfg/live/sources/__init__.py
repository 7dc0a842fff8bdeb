"""Where positions come from: pipes, sockets, datasets, bags of ROS 2; a queue in which live lines wait."""
