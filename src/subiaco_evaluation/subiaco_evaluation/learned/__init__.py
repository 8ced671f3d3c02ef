"""Learned change detection of the literature, for comparison; only modules of this package import PyTorch."""
