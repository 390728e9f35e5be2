"""Labelling of captures in a browser."""
