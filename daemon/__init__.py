"""The service, its command line and the operator's console."""
