"""Devices, their simulated world, capture, recording and replay."""
