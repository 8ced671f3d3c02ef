"""The change run in tiles: stages on 80 m of city with its surroundings, never on all of it at once."""
