"""How much of what has no end is tried: a fifth in each run of CI, all of it before a release."""

import os

SHARE = int(os.environ.get("STATION_TEST_SHARE", "5"))  # one in so many boundaries, years and kills
