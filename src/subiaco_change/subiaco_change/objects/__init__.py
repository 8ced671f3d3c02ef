"""Objects of both epochs as voxels, and what is measured on them: heights, volumes, free space."""
