"""Adapters for packages of others: see docs/third-party.md."""
