"""Checks before a robot runs: link, computer, robot at rest, motors on a rack, and IMU on the ground."""
