"""What the V4L2 backend is made of; the driver is `drivers.colour_v4l2`."""
