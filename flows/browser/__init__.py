"""A local, read-only web page over a catalog, `coslidar browse`."""
