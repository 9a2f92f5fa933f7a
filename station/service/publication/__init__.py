"""Publishing by a process of its own: what it sends, where to, and what it remembers of it."""
