"""Robot models: kinematics, inverse kinematics, limits."""
