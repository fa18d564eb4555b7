"""surefoot: agile gaits for quadruped robots, learned in simulation and carried to the robot."""

__version__ = "0.6.0"
