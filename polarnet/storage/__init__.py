"""Stores of events, frames and scenes on disk, and their export for other tools."""
