"""The service: its loop, schedule, worker, publishing and retention. It contains no equations."""
