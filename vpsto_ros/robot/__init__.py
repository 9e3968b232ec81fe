"""Robot models: kinematics, inverse kinematics, limits."""

import vpsto_ros.kernel_cache  # noqa: F401 (before the first kernel)
