"""Work in independent pieces: what they leave, what they rest on, and who does them."""
