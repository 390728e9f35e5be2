"""The re-check of the whole chain."""
