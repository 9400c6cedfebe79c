"""What can be set of each algorithm; help and checks of settings read it, and need no PyTorch."""
