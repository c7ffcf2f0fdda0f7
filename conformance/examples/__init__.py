"""Adapters for packages of others: see docs/strangers.md."""
