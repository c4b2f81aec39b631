"""The failure probability over memory times: bursts of misses, from short to long."""
