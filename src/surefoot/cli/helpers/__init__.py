"""Modules shared by several commands, and parts of long commands."""
