"""Where the sensors sit and how far their clocks are off, from a short recording of a moving vehicle."""
