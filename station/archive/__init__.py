"""Arrays to bytes: what others read."""
