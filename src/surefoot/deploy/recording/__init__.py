"""The record of a run: rows while it goes on, a trace at its end, motion capture where there is any."""
