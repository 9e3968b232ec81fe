"""What plans do to the uncertainty about an object (ch. 6)."""

import vpsto_ros.kernel_cache  # noqa: F401 (before the first kernel)
