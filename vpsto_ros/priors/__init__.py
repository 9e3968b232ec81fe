"""Gaussian priors over via-points (4.3.1)."""
