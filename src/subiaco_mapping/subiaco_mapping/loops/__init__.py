"""Places seen twice: submaps, their descriptors, registration, and what the graph thinks of it."""
