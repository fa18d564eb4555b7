"""Policies that others trained, brought in as policy files of surefoot."""
