"""The networks' kernels for CUDA (`toolkit/gpu.py`)."""
