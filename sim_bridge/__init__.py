"""Everything simulated: the robot cell, its driver, the demos and the experiments."""
