"""What the IIDC backend is made of; the driver is `drivers.colour_iidc`."""
