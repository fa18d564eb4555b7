"""Readers of what other frameworks write beside their networks: each returns a `PolicySpecification`."""
