"""Contact dynamics: planar shapes and quasi-static pushing (6.3.1)."""

import vpsto_ros.kernel_cache  # noqa: F401 (before the first kernel)
