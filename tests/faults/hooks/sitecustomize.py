"""Python runs this at the start of every process of the service under test."""

import os

if "FAULTS_PLAN" in os.environ:
    import boundaries

    is_service = "FAULTS_SERVICE" not in os.environ
    boundaries.install()
    if is_service:
        boundaries.shorten_delays()
