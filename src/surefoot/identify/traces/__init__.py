"""Fits to traces of deployments."""
