"""State estimation of manipulated objects."""
