"""Arrays to arrays: the equations. No file, clock, log, thread or setting is touched here."""
