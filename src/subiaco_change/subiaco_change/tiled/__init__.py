"""The change run in tiles: every stage on 80 m of city with its surroundings, nothing on all of it at once."""
