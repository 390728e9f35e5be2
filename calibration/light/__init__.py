"""The light and how the surface's brightness follows from it."""
