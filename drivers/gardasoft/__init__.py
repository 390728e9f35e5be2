"""What the light's backend is made of; the driver is `drivers.light_gardasoft`."""
