"""Pixel models of event cameras, compiled: light and state of one plane in, events and state out."""
