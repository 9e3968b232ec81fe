"""Duration over the number and the timing of via-points: Figs 3.5 and 4.6."""
