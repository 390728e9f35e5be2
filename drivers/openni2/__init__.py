"""The project's own binding of OpenNI2, its runtime, and two driver plug-ins: Kinect v1 and a virtual one."""
