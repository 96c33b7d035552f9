"""Kernels in Triton, for CUDA. Only imported where `dispatch` has found that they can be used."""
