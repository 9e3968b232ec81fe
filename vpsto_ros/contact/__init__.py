"""Contact dynamics: planar shapes and quasi-static pushing (6.3.1)."""
