"""The policy file: its contract, its export and the runtime that runs it."""
