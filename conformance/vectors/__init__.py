"""Golden vectors: inputs and right results in files, for implementations in any language. The format is described in
docs/vectors.md."""
