"""Air hockey: how well pucks are predicted."""
