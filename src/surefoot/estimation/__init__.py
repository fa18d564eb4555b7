"""Estimates of the base motion from the sensors of a robot, with numpy only."""
