"""Two epochs into one frame, and how far to trust it (method, part B)."""
