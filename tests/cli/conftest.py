from method_fixtures import checkpoints

__all__ = ["checkpoints"]
