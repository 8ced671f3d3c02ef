"""How good a map is, told to the surveyor who has to sign it."""
