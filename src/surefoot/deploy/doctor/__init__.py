"""Checks before a robot runs: link, computer, robot at rest, motors on a rack, IMU on the ground."""
