"""Experiments with a robot that hangs on a rack: plans, replay model, fits."""
