"""The stochastic search over via-points: evolution strategies, cost terms and VP-STO (4.3)."""

import vpsto_ros.kernel_cache  # noqa: F401 (before the first kernel)
