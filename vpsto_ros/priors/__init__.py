"""Gaussian priors over via-points (4.3.1)."""

import vpsto_ros.kernel_cache  # noqa: F401 (before the first kernel)
