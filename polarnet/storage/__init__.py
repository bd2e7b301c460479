"""Stores of events, frames and scenes on disk, and their exchange with other tools."""
