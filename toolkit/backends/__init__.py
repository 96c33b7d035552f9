"""Kernels: numba's for the CPU, Triton's for CUDA. Which of them runs is decided in `dispatch`."""
