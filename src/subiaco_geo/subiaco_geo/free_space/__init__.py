"""Free space: which places an epoch knows to be free, occupied, or does not know."""
