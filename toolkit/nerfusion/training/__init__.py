"""Training of the NeRFusion networks across scenes (NeRFusion, section 3.4 and 4)."""
