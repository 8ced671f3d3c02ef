"""A bag before it is mapped: whether it is usable, and why not."""
