"""Streets of two families, drawn from a seed: an Australian suburb and a dense European street."""
