"""Experiments on a robot that stands on the ground: plans, motion, inverse dynamics, fits."""
