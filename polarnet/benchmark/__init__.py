"""Evaluation of methods: running, scoring and comparing them."""
