"""Collision checking: of a point in the plane, and of the links of an arm."""
