"""The networks' kernels for CUDA."""
