"""Pictures and files for people: maps, GeoTIFF, the station's page."""
