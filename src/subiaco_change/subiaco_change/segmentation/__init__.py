"""Ground, features, superpoints, classes and instances of one epoch (method, part C)."""
