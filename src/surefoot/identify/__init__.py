"""Experiments on a robot, and how well a simulator repeats them."""
