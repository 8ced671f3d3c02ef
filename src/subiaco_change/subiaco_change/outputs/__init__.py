"""The change directory (contracts of the table, clouds and rasters)."""
