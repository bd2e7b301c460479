"""Device, threads, worker processes, files, and checks of arrays and ranges, which all other packages use."""
