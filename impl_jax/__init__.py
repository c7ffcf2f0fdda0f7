"""The JAX backend: pure functions over the flat parameter mapping, one module for each row of the grid."""
