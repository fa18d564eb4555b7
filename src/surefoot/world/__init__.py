"""Simulated worlds, from motor angles to readings: engines, sensors and `SimWorld`."""
