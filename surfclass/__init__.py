"""Values and algorithms that turn captures into a classified 3D map: arrays in, arrays out."""
