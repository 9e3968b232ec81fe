"""A point among obstacles in the plane: Figs 4.4, 4.5 and 4.7."""
