"""The colour camera's radiometric response."""
