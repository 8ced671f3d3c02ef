"""Known changes put into a real map: what one would find on one's own city."""
