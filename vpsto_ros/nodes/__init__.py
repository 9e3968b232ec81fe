"""The ROS 2 lifecycle nodes around the library."""
