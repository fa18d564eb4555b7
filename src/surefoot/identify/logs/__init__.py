"""Logs of robots that others recorded: import, replay, fits."""
