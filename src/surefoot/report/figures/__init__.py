"""Figures with matplotlib, in one style."""
