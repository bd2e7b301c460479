"""Device, threads, worker processes, array and range checks: what every room builds on."""
