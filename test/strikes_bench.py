"""A stand-in for the table of strikes: lateral ones are twice as fast, near ones faster than far ones."""

import numpy as np

START = np.array([0.0, -0.196, 0.0, -1.844, 0.0, 0.970, 0.0])


class StandInStrikes:
    """Largest speeds as measured of the iiwa in about the postures of a strike, in a formula."""

    def __init__(self, lead=0.6, slowest=1.2):
        self.x, self.y = np.linspace(-0.70, -0.20, 11), np.linspace(-0.40, 0.40, 17)
        self.angle = np.deg2rad(np.linspace(-70.0, 70.0, 29))
        self.center = np.array([1.51, 0.0])
        self.contact_distance = 0.0798  # of puck and mallet in the model that comes with the package
        self._lead, self._slowest = lead, slowest

    def speeds(self, puck, angles):
        """A quarter slower at the far end; (1, 1.15, 2) times as fast at (0, 30, 60) degrees."""
        inside = (puck[:, 0] >= self.x[0] - 1e-9) & (puck[:, 0] <= self.x[-1] + 1e-9)
        inside &= (np.abs(puck[:, 1]) <= self.y[-1] + 1e-9) & (np.abs(angles) <= self.angle[-1] + 1e-9)
        slowest = self._slowest * (1.0 - 0.5 * (puck[:, 0] + 0.7))
        return np.where(inside, slowest * (1.0 + np.abs(angles / np.deg2rad(60.0)) ** 2.7), 0.0)

    def timely_speeds(self, joints, puck, angles, available):
        """All or nothing."""
        return np.where(self.lead(joints, puck, angles) <= available, self.speeds(puck, angles), 0.0)

    def lead(self, joints, puck, angles):
        """Longer for lateral strikes and for places far from the middle."""
        return self._lead + 0.3 * np.abs(angles) + 0.2 * np.abs(puck[:, 1])
