"""Known changes put into a real map, to learn how small a change is found there."""
