"""Pixel models of event cameras, compiled: light and pixel state in, events and new state out."""
