"""Devices, memory and compiled programs."""
