"""Collision checking: of a point in the plane, and of the links of an arm."""

import vpsto_ros.kernel_cache  # noqa: F401 (before the first kernel)
