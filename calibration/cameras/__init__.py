"""The two cameras and how they stand to each other."""
