"""The arm among obstacles, offline and online."""
