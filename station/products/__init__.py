"""Products for people and other programs: maps, tables, GeoTIFF, the station's page."""
