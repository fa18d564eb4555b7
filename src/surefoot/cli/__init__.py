"""Command line: one module per command. Only here are all packages connected."""
