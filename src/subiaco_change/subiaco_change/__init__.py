"""Two maps to objects, and objects to a table of changes."""
