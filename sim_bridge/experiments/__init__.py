"""Experiments in lock-step, without ROS: one module per table or figure."""
