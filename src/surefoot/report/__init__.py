"""Figures, videos and web pages. All metrics are computed elsewhere, in `evaluation`."""
