"""Sparse linear algebra of the transcription.

- `block_band`: block-banded matrices of a time grid; `sparse_assembly`: their entries as one sparse
  matrix.
- `factorisation`: factorisation of one time step, with `supernodal` (sparse) and `lapack` (banded);
  `reused_factor`: factors that serve several time steps.
"""
