"""What arrived and what was done with it: inbox, journal of the scans, lock on the data folder."""
