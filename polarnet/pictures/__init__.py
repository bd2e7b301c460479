"""Pictures from files, from scikit-image and from seeds: one size, one colour space, split by source picture."""
