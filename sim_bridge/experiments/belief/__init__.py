"""Beliefs through contacts (ch. 6) without a simulator: prediction, priors, robust plans, ablation."""
