"""What the Aravis backend is made of; the driver is `drivers.colour_aravis`."""
