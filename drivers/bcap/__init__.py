"""b-CAP, Denso's controller protocol; the driver is `drivers.arm_bcap`."""
