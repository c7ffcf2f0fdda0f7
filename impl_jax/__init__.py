"""The JAX backend: pure functions over the flat parameter mapping, one module for each chapter."""
