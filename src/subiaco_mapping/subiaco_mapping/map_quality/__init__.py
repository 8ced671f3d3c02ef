"""How good a map is: figures, checks, and a page."""
