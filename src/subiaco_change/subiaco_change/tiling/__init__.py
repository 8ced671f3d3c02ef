"""The stages of a change run, tile by tile, with memory that does not grow with the city."""
