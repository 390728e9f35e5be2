"""Drivers in processes of their own; `drivers.isolation.camera.camera` is how they are used."""
