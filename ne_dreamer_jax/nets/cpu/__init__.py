"""Lowerings of convolutions for CPUs."""
