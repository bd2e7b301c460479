"""Pictures from files, wheels and seeds, made alike and split by source."""
