from method_fixtures import checkpoints, context, make_context, make_sequence, make_setup, sequence

__all__ = ["checkpoints", "context", "make_context", "make_sequence", "make_setup", "sequence"]
