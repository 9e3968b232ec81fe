"""Robust pushing: planning in belief space, BS-VP-STO (6.4) and its receding horizon (6.5)."""
