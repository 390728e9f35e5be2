"""Guided live capture: views by a resting arm or on request, judged at once, on a page and a terminal."""
