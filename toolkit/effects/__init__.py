"""Effects of cameras, light and sensors: one module each, with its parameters and its forward model."""
