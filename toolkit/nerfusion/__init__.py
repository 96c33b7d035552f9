"""NeRFusion (Zhang et al., CVPR 2022): from posed images to a sparse radiance field; `model.py` reads in the paper's order."""
