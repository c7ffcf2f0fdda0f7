"""Renderings of the result of a run: every one is made from the same plain data (conformance/results.py)."""
