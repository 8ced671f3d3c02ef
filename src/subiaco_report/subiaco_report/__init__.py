"""Pages, pictures, QGIS project and delivery: a change directory as people read it."""
