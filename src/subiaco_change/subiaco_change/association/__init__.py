"""Which object of one epoch is which object of the other (method, part D)."""
