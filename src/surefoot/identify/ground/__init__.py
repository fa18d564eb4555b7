"""Experiments with a robot that stands on the ground: plans, smoothed motion, inverse dynamics, fits."""
