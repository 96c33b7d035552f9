"""What goes beyond the paper, one module each."""
