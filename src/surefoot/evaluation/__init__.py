"""Evaluation of policies: episodes, and metrics of their traces (speed, power, return, gait, tracking, reality gap)."""
