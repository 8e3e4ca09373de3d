"""ROS 2 nodes: they read parameters, call the core and publish; no arithmetic lives here."""
