from event_fixtures import make_events, make_random_events, same_events

__all__ = ["make_events", "make_random_events", "same_events"]
