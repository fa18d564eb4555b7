"""Figures and video for people to look at; nothing here computes a number that evaluate does not."""
