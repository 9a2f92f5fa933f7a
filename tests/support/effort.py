"""How much of what has no end is tried: a tenth, drawn in each run of CI, and all of it before a release."""

import os

SHARE = int(os.environ.get("STATION_TEST_SHARE", "10"))  # one in so many
