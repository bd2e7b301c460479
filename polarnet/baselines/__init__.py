"""What people use today: events to intensity, one polarizer at a time, and constants."""
