"""Joint angles from a CAN bus; the driver is `drivers.arm_can`."""
