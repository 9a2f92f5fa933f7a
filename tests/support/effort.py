"""How much of what has no end is tried: a third in each run of CI, all of it before a release."""

import os

SHARE = int(os.environ.get("STATION_TEST_SHARE", "3"))  # one in so many boundaries, years and kills
