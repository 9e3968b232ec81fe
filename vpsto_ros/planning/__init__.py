"""Planners that run in the loop: online VP-STO and planar pushing (4.4, 4.5.2)."""
