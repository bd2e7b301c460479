from method_fixtures import context, make_context, make_sequence, make_setup, sequence

__all__ = ["context", "make_context", "make_sequence", "make_setup", "sequence"]
