"""Learning models from recorded episodes: ``vpsto learn``."""
