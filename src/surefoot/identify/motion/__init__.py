"""Recorded motion from deployment traces and third-party logs, and fits of physical parameters to it."""
