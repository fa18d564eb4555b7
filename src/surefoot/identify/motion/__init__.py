"""Recorded motion, from traces of deployments and from anybody's logs, and the fits to it."""
