"""A link to a robot."""

from __future__ import annotations


class LinkLostError(RuntimeError):
    """The port is gone: unplugged, or its other end has closed."""
