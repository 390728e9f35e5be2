"""The hand-eye transform."""
