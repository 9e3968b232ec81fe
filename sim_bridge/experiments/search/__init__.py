"""Every choice in the search against its alternatives."""
