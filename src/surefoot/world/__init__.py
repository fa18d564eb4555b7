"""Simulated worlds, from motor angles to readings: engines, sensors and `SimWorld`."""

from surefoot.world.interface import Readings, Simulation, Truth, World

__all__ = ["Readings", "Simulation", "Truth", "World"]
