"""Readers of other frameworks' policy configurations; each returns a `PolicySpecification`."""
