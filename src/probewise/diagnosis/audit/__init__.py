"""A plan judged before any data: what it cannot see, what it cannot tell apart, and the cure."""
