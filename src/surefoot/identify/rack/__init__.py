"""Experiments on a robot that hangs on a rack: plans, model, fits."""
