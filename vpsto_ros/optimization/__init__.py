"""The stochastic search over via-points: evolution strategies, cost terms and VP-STO (4.3)."""
